"""The locks of a run directory: one process trains in it at a time, and one writes its evaluation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import IO_ERRNOS
from hma_jax.runtime.locks import Held, Lock, exclusive

NAME, EVALUATION = ".lock", ".evaluation.lock"

CHECKPOINTS = "checkpoints"
"""The folder of a run directory that has a folder per checkpoint. It is named and listed here, so that a program that
only lists checkpoints does not import Orbax."""


def list_steps(directory: Path) -> list[int]:
    """Steps with a finished checkpoint, in order; unfinished checkpoints have other names."""
    if not directory.is_dir():
        return []
    numbered = [path for path in directory.iterdir() if path.name.isascii() and path.name.isdecimal()]
    return sorted(int(path.name) for path in numbered if path.is_dir())


class RunBusy(Held):
    """Another process works in the directory."""


def is_address(path: Path) -> bool:
    """Whether a path was made from a URL such as gs://bucket/run, in which `Path` keeps only one slash."""
    return re.match(r"[a-z][a-z0-9+.-]+:/", str(path)) is not None


def require_plain(directory: Path) -> None:
    """Raises ConfigError for a path with brackets, because checkpoints written there could not be read: Orbax looks for
    the files of the processes with a pattern that begins with the path."""
    found = re.search(r"\[[^/]+\]", str(directory.absolute()))
    require(
        found is None,
        f"{directory.absolute()}: a path with {found and found[0]} cannot hold checkpoints, because Orbax reads it as "
        "a pattern; choose another directory",
    )


@contextmanager
def locked_run(run_dir: Path, name: str = NAME) -> Iterator[Lock]:
    """Makes `run_dir` and holds it: to train in it or, with EVALUATION, to write the evaluation of its model.
    Raises RunBusy, which names the process that already holds it, ConfigError if it cannot be written, and OSError if
    its disk fails."""
    require(
        not is_address(run_dir),
        f"a run directory must be on a file system, got the address {run_dir}; mount the bucket, or choose a disk "
        "that all hosts share",
    )
    with ExitStack() as stack:
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context(exclusive(run_dir / name))
        except Held as held:
            what, how = ("evaluated", "") if name == EVALUATION else ("trained in", " (Ctrl-C saves first)")
            raise RunBusy(
                f"{run_dir} is being {what} by {held.who}; wait for it or stop it{how}, or choose another run directory",
                held.holder,
            ) from None
        except OSError as error:
            if error.errno in IO_ERRNOS:
                raise
            raise ConfigError(
                f"cannot write to the run directory {run_dir}: {error.strerror}; choose another output directory "
                "or fix its permissions"
            ) from error
        yield lock
