"""Reading checkpoints: verified by hash, or refused with the name of the damaged file.

A checkpoint DIRECTORY/<step> holds a folder per item (the fields of a state), Orbax's own files, the
description of its run, and the list of all of these with their hashes (`training.hashes`). Only the
items that are asked for are read and checked.
"""

from __future__ import annotations

import errno
import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from hma_jax.config import ConfigError
from hma_jax.runtime.processes import all_gather, broadcast_from_writer, is_writer
from hma_jax.training.hashes import Damaged, ReadError, verify
from hma_jax.training.run_lock import list_steps

log = logging.getLogger(__name__)


class CheckpointError(ConfigError):
    """A checkpoint that is missing, unreadable or belongs to another configuration."""


def agree_on_latest(directory: Path) -> int | None:
    """The latest step with a checkpoint as process 0 sees it: a shared disk may show the others an older state of the
    directory. Raises ReadError, in all processes, if the directory cannot be listed at the moment."""
    steps: list[int] = []
    with raised_in_all("checkpoints"):
        try:
            if is_writer():
                steps = list_steps(directory)
        except OSError as error:  # not `ReadError.of`: its advice would remove every checkpoint
            raise ReadError(
                f"{directory} cannot be read now ({error.strerror}). Run the same command again when its disk answers"
            ) from error
    latest = broadcast_from_writer("latest checkpoint", str(steps[-1]) if steps else "")
    return int(latest) if latest else None


@contextmanager
def raised_in_all(name: str) -> Iterator[None]:
    """Raises in all processes the first CheckpointError or ReadError that any of them raises in the block. All
    processes must run the block."""
    own: CheckpointError | ReadError | None = None
    try:
        yield
    except (CheckpointError, ReadError) as error:
        own = error
    told = "" if own is None else f"{type(own).__name__}: {own}"
    first = next(filter(None, all_gather(name, told)), "")
    if own is not None and told == first:
        raise own
    if first:
        kind, _, message = first.partition(": ")
        raise {"CheckpointError": CheckpointError, "ReadError": ReadError}[kind](message)


def find_damage(checkpoint: Path) -> Damaged | None:
    """The first damaged file; None if there is none. Raises ReadError."""
    try:
        verify(checkpoint)
    except Damaged as damage:
        return damage
    return None


def require_finished(checkpoint: Path) -> None:
    """Raises CheckpointError, in all processes, if the list of the files of `checkpoint` is missing or damaged."""
    with raised_in_all("finished"), _reading(checkpoint):
        verify(checkpoint, lambda name: False)


def read_description(checkpoint: Path) -> dict[str, Any]:
    """The description of the run that wrote the checkpoint. Raises CheckpointError if its files are damaged, ReadError
    if they cannot be read at the moment."""
    with _reading(checkpoint):
        verify(checkpoint, lambda name: "/" not in name)
        # Orbax warns, for every item, about a path that is not absolute.
        return ocp.checkpointables_metadata(checkpoint.absolute()).custom_metadata or {}


def load_items(checkpoint: Path, shapes: Mapping[str, Any]) -> dict[str, Any]:
    """The items that `shapes` names, each laid out as its tree of jax.ShapeDtypeStruct says, or in host memory if the
    tree is of NumPy arrays (`on_host`).

    With several processes all call this. Raises CheckpointError if a file of these items is damaged or missing,
    ReadError if one cannot be read at the moment.
    """
    share = jax.process_index(), jax.process_count()
    with raised_in_all("damage"), _reading(checkpoint):
        verify(checkpoint, lambda name: name.split("/")[0] in shapes, share)
    with _reading(checkpoint):
        return ocp.load_checkpointables(checkpoint, dict(shapes))


def on_host(shapes: Any) -> Any:
    """A tree of shapes (jax.ShapeDtypeStruct) as a tree of NumPy arrays, which take no memory themselves. With it Orbax
    reads into host memory, not onto devices."""
    return jax.tree.map(lambda x: np.broadcast_to(np.zeros((), x.dtype), x.shape), shapes)


def has_item(checkpoint: Path, name: str) -> bool:
    """Whether a checkpoint has an item of this name. Raises CheckpointError if the checkpoint is gone, ReadError if it
    cannot be read at the moment."""
    with _reading(checkpoint):
        return name in os.listdir(checkpoint)


@contextmanager
def _reading(checkpoint: Path) -> Iterator[None]:
    """Turns damage, and whatever Orbax raises for it (types of four libraries), into a CheckpointError, and errors of
    the system about a disk into a ReadError."""
    hush_orbax()
    try:
        yield
    except Damaged as damage:
        raise CheckpointError(
            f"the checkpoint {checkpoint} is damaged: {damage.path.relative_to(checkpoint)} {damage.reason}; "
            + _advice(checkpoint)
        ) from damage
    except ReadError:
        raise
    except Exception as error:
        code = error_code(error)
        if code not in (None, errno.ENOENT, errno.ENOTDIR):
            raise ReadError.of(checkpoint, os.strerror(code)) from error
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise CheckpointError(
            f"the checkpoint {checkpoint} cannot be read ({reason[:160]}); if its files are damaged, remove this "
            "directory to continue from an earlier checkpoint"
        ) from error


def error_code(error: Exception) -> int | None:
    """The operating system's error number, which Orbax's storage library gives inside its message."""
    found = re.search(r"os_error_code='(\d+)'", str(error))
    return int(found[1]) if found else error.errno if isinstance(error, OSError) else None


def _advice(checkpoint: Path) -> str:
    directory = checkpoint.parent
    try:
        earlier = [step for step in list_steps(directory) if step < int(checkpoint.name)]
        whole = next((step for step in reversed(earlier) if find_damage(directory / str(step)) is None), None)
    except OSError:
        return "those before it cannot be read now: run the same command again when their disk answers"
    if whole is None:
        return "there is no undamaged checkpoint before it: train again in a new output directory"
    return (
        f"that of step {whole} is undamaged: to continue from there, train with --skip-damaged (in Python "
        "LoopOptions(skip_damaged=True)), or remove this directory"
    )


def hush_orbax() -> None:
    """From now on Orbax logs no errors. It raises each of them as well, and its log entries are pages of tracebacks and
    of damaged files, some from threads that continue after a save has failed."""
    logging.getLogger("absl").addFilter(_is_no_error_of_orbax)  # once, however often it is added


def _is_no_error_of_orbax(record: logging.LogRecord) -> bool:
    return record.levelno < logging.ERROR or "orbax" not in record.pathname
