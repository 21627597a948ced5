"""Checkpoints: whole or absent, on any mesh, and never mistaken for another run's.

Orbax (v1) writes asynchronously into a temporary directory and renames. Beside the arrays
every checkpoint carries `meta`, the JSON description of the run (configurations, embodiment
table, data provenance); restoring under another description is refused by name.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from hma_jax.config import ConfigError
from hma_jax.config.json import diff


class CheckpointError(ConfigError):
    """A checkpoint that is missing, unreadable or belongs to another configuration."""


class Checkpoints:
    """The checkpoints of one run. Use as a context manager: leaving waits for pending saves."""

    def __init__(self, directory: Path, meta: dict[str, Any], keep: int = 2):
        """Raises CheckpointError if `directory` cannot be written."""
        self.directory = Path(directory).absolute()
        self.meta = meta
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CheckpointError(
                f"cannot create the checkpoint directory {self.directory}: {error.strerror}; "
                "choose another output directory"
            ) from error
        with _log_silenced():
            self._orbax = ocp.training.Checkpointer(
                self.directory,
                preservation_policy=ocp.training.preservation_policies.LatestN(keep),
                # A save cut short by a kill leaves a temporary directory; drop it.
                cleanup_tmp_directories=True,
            )

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *exc: object) -> None:
        self._orbax.close()

    @property
    def latest_step(self) -> int | None:
        latest = self._orbax.latest
        return None if latest is None else latest.step

    def save(self, step: int, state: Any) -> None:
        """Starts an asynchronous save; the arrays are copied before this returns."""
        # Without `force` Orbax drops a save that comes while the previous one is being written.
        self._orbax.save_async(step, state, custom_metadata=self.meta, force=True)

    def wait(self) -> None:
        self._orbax.wait()

    def restore(self, like: Any, ignore: tuple[str, ...] = ()) -> Any:
        """The latest state, laid out as the arrays of `like` are.

        `ignore` lists fields of `meta` ('train.steps') that may differ. Raises CheckpointError
        naming every other difference, or if the files are damaged.
        """
        step = self.latest_step
        if step is None:
            raise CheckpointError(f"no checkpoint under {self.directory}")
        with _reading(self.directory / str(step)):
            saved = self._orbax.metadata(step).custom_metadata or {}
        if saved.keys() != self.meta.keys():
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) is of another kind of run: it describes "
                f"{', '.join(sorted(saved)) or 'nothing'}, not {', '.join(sorted(self.meta))}; use a new "
                "output directory"
            )
        changes = [line for line in diff(saved, self.meta) if line.split(":")[0] not in ignore]
        if changes:
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) was made by another "
                "configuration; use a new output directory or restore these fields:\n  "
                + "\n  ".join(changes)
            )
        abstract = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), like
        )
        with _reading(self.directory / str(step)):
            return self._orbax.load(step, abstract)


@contextmanager
def _reading(checkpoint: Path) -> Iterator[None]:
    """Whatever Orbax raises for a damaged file (types of four libraries) becomes a CheckpointError."""
    try:
        with _log_silenced():
            yield
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise CheckpointError(
            f"the checkpoint {checkpoint} cannot be read ({reason[:160]}); if its files are damaged, remove "
            "this directory to go on from an earlier checkpoint"
        ) from error


@contextmanager
def _log_silenced() -> Iterator[None]:
    """Orbax quotes damaged files in its log, whole."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def read_checkpoint(directory: Path) -> tuple[int, Any, dict[str, Any]]:
    """(step, state as nested dicts of arrays on the default device, meta) of the latest one.

    Raises CheckpointError if there is none or it is damaged.
    """
    directory = Path(directory).absolute()
    if not directory.is_dir():
        raise CheckpointError(f"no checkpoints at {directory}; give the directory of a training run")
    with _log_silenced():
        opened = ocp.training.Checkpointer(directory)
    with opened as orbax:
        if orbax.latest is None:
            raise CheckpointError(f"no finished checkpoint under {directory}; resume its training first")
        step = orbax.latest.step
        with _reading(directory / str(step)):
            metadata = orbax.metadata(step)
            if metadata.metadata is None:
                raise ValueError("the description of its arrays is damaged")
            # Saved on one mesh, read on whatever this process has: put everything on one device.
            device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
            abstract = jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), metadata.metadata
            )
            return step, orbax.load(step, abstract), metadata.custom_metadata or {}
