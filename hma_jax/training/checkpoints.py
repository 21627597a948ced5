"""Checkpoints: whole or absent, on any mesh, and never mistaken for another run's.

Orbax (v1) writes asynchronously into a temporary directory and renames. Each field of a state is an item
of its own, so that parameters are read without moments. Beside them every checkpoint carries the JSON
description of its run (configurations, embodiment table, data provenance); restoring under another
description is refused by name. Once a checkpoint is finished, its files are listed with their hashes, and
whoever reads it checks them.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from hma_jax.config import ConfigError
from hma_jax.config.json import diff
from hma_jax.runtime.files import sync, sync_tree
from hma_jax.runtime.processes import is_writer, writer_first
from hma_jax.training.hashes import write_list
from hma_jax.training.reading import (
    CheckpointError,
    agree_on_latest,
    error_code,
    find_damage,
    hush_orbax,
    list_steps,
    load_items,
    read_description,
)
from hma_jax.training.run_lock import require_plain

Description = dict[str, Any]

Load = Callable[[Path, Mapping[str, Any]], dict[str, Any]]
"""Reads the items of a checkpoint, as `load_items`."""

log = logging.getLogger(__name__)


class SaveError(OSError):
    """Something of a run could not be written. Its last finished checkpoint is kept."""


class Checkpoints:
    """The checkpoints of one run. Use as a context manager: leaving waits for pending saves."""

    def __init__(
        self,
        directory: Path,
        meta: Description,
        keep: int = 2,
        modernise: Callable[[Description], Description] = lambda described: described,
        keep_steps: tuple[int, ...] = (),
        keep_every: int = 0,
    ):
        """The newest `keep` checkpoints stay, those of `keep_steps`, and of every `keep_every` steps (0: none).
        `modernise` brings a description that an earlier version wrote to the form of `meta`.

        Raises CheckpointError if `directory` cannot be written, ConfigError if what is written there cannot be read, or
        for a description that is not JSON.
        """
        require_plain(directory)
        try:
            json.dumps(meta)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"the description of a run, including its provenance, must be JSON: {error}") from error
        self.directory = Path(directory).absolute()
        self.meta, self.keep, self.modernise = meta, keep, modernise
        self.keep_steps, self.keep_every = keep_steps, keep_every
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CheckpointError(
                f"cannot create the checkpoint directory {self.directory}: {error.strerror}; "
                "choose another output directory"
            ) from error
        self._orbax: ocp.training.Checkpointer | None = None
        self._background = ThreadPoolExecutor(1, "checkpoint")
        self._pending: tuple[int, Future[None]] | None = None
        self._bytes = 0  # of the state that was saved last

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.wait()
        except SaveError as error:
            if kind is None:
                raise
            log.warning("%s", error)  # the earlier exception is the one to raise
        finally:
            self._background.shutdown()
            self._close_orbax()

    @property
    def latest_step(self) -> int | None:
        return max(list_steps(self.directory), default=None)

    # --- Saving ------------------------------------------------------------------------------

    def save(self, step: int, state: Any) -> None:
        """Starts an asynchronous save of a named tuple, an item per field that is not None; the arrays
        are copied before this returns.

        Raises SaveError if this save or the one before it could not be written.
        """
        self.wait()
        items = {name: item for name, item in state._asdict().items() if item is not None}
        self._bytes = sum(x.nbytes for x in jax.tree.leaves(items))
        try:
            _require_writable(self.directory)
            # Without `force` Orbax may decide that this step need not be saved.
            response = self._writer().save_checkpointables_async(step, items, custom_metadata=self.meta, force=True)
        except Exception as error:
            raise self._failed(step, error) from error
        self._pending = step, self._background.submit(self._finish, step, response)

    def raise_failure(self) -> None:
        """Raises the SaveError of a save that has failed since; does not wait for one that is under way."""
        if self._pending is not None and self._pending[1].done():
            self.wait()

    def wait(self) -> None:
        """Until the last save is finished and listed. Raises SaveError if it could not be written."""
        if self._pending is None:
            return
        (step, future), self._pending = self._pending, None
        try:
            future.result()
        except Exception as error:
            raise self._failed(step, error) from error

    def _writer(self) -> ocp.training.Checkpointer:
        """Created at the first save: by then the directory holds only checkpoints that this run continues from."""
        if self._orbax is None:
            hush_orbax()
            policies = ocp.training.preservation_policies
            self._orbax = ocp.training.Checkpointer(
                self.directory,
                preservation_policy=policies.AnyPreservationPolicy(
                    [policies.LatestN(self.keep), policies.CustomSteps(self.keep_steps)]
                    + [policies.EveryNSteps(self.keep_every)] * (self.keep_every > 0)
                ),
                # A save that was killed leaves a temporary directory; remove it.
                cleanup_tmp_directories=True,
            )
        return self._orbax

    def _finish(self, step: int, response: Any) -> None:
        """In the background: waits for Orbax, then flushes what it wrote to disk and lists it."""
        response.result()
        if is_writer():
            sync_tree(self.directory / str(step))  # Orbax flushes arrays alone, neither its other files nor their names
            sync(self.directory)
            write_list(self.directory / str(step))

    def _failed(self, step: int, error: Exception) -> SaveError:
        """The error to raise for a failed save. What it left half-written is removed by the next start."""
        self._close_orbax()
        latest = self.latest_step
        reason = _reason(error)
        if latest is None:
            again = "it starts from step 0, since there is no checkpoint yet"
        else:
            again = f"it continues from step {latest}, the last complete checkpoint"
        return SaveError(
            f"the checkpoint of step {step} could not be written to {self.directory}: {reason}. {self._space()}Make "
            f"sure that there is space and permission to write, then run the same command again: {again}"
        )

    def _space(self) -> str:
        try:
            free = shutil.disk_usage(self.directory).free
        except OSError:  # the directory itself is gone
            return ""
        return f"It takes about {_size(self._bytes)}, and {_size(free)} are free there. "

    def _close_orbax(self) -> None:
        orbax, self._orbax = self._orbax, None
        if orbax is not None:
            try:
                orbax.close()
            except Exception as error:  # of the save that failed, which `wait` has raised already
                log.debug("error when closing the checkpoints at %s: %s", self.directory, error)

    # --- Restoring ---------------------------------------------------------------------------

    def restore(
        self,
        shapes: Any,
        may_change: Callable[[Description, int], tuple[str, ...]] = lambda saved, step: (),
        skip_damaged: bool = False,
        load: Load = load_items,
    ) -> tuple[int, Any]:
        """(step, state) of the latest checkpoint, laid out as `shapes` (jax.ShapeDtypeStruct) say, read by `load`.

        `may_change` says which fields of its description ('train.steps') may differ, at its step. With `skip_damaged`,
        checkpoints after the newest whole one are moved to `damaged` beside this directory. Raises
        CheckpointError naming every other difference, or the file that is damaged; ReadError if one cannot be read now.
        """
        if skip_damaged:
            with writer_first("damaged checkpoints"):
                if is_writer():
                    self._move_damaged_away()
        step = agree_on_latest(self.directory)
        if step is None:
            raise CheckpointError(f"no checkpoint in {self.directory}")
        checkpoint = self.directory / str(step)
        saved = read_description(checkpoint)
        if saved.keys() != self.meta.keys():
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) belongs to another kind of run: it describes "
                f"{', '.join(sorted(saved)) or 'nothing'}, not {', '.join(sorted(self.meta))}; use a new output "
                "directory"
            )
        saved = self.modernise(saved)
        free = may_change(saved, step)
        changes = [line for line in diff(saved, self.meta) if line.split(":")[0] not in free]
        if changes:
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) was made with another configuration; use a new "
                "output directory, go on in a branch (`hma branch`: other optimiser, masks, seed or steps), or restore "
                "these fields:\n  " + "\n  ".join(changes)
            )
        wanted = {name: item for name, item in shapes._asdict().items() if item is not None}
        return step, type(shapes)(**load(checkpoint, wanted))

    def _move_damaged_away(self) -> None:
        damaged = []
        for step in reversed(list_steps(self.directory)):
            damage = find_damage(self.directory / str(step))
            if damage is None:
                break
            damaged.append((step, damage))
        else:
            raise CheckpointError(
                f"all checkpoints in {self.directory} are damaged; train again in a new output directory"
            )
        for step, damage in damaged:
            aside = self.directory.parent / "damaged" / str(step)
            while aside.exists():
                aside = aside.with_name(f"{aside.name}-again")
            aside.parent.mkdir(exist_ok=True)
            os.replace(self.directory / str(step), aside)
            log.warning("the checkpoint of step %d is damaged (%s) and was moved to %s", step, damage, aside)


def _require_writable(directory: Path) -> None:
    """Raises OSError if nothing can be created in `directory`. Orbax would fail in a thread that others then wait for
    without end."""
    if not os.access(directory, os.W_OK | os.X_OK):
        read_only = directory.is_dir() and os.statvfs(directory).f_flag & os.ST_RDONLY
        code = errno.EROFS if read_only else errno.EACCES if directory.is_dir() else errno.ENOENT
        raise OSError(code, os.strerror(code), str(directory))


def _size(count: int) -> str:
    """A number of bytes with a unit: '7.34 GB'."""
    power = min(int(math.log10(max(count, 1)) / 3), 4)
    return f"{count / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB')[power]}"


def _reason(error: Exception) -> str:
    """One line: the operating system's message, if there is one."""
    if code := error_code(error):
        return os.strerror(code)
    return " ".join(f"{type(error).__name__}: {error}".split())[:160]
