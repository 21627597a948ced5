"""Directories that are never seen half written."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_jax.config import require
from hma_jax.runtime.outputs import unwritable


def require_free(directory: Path) -> None:
    """Raises ConfigError if there is something at `directory`, which an output would replace."""
    directory = Path(directory)
    empty = directory.is_dir() and not any(directory.iterdir())
    require(
        empty or not directory.exists(),
        f"{directory} exists already; choose another output directory or remove it",
    )


@contextmanager
def written_aside(directory: Path) -> Iterator[Path]:
    """A new directory to write into, which takes the place of `directory` when the block ends well.

    Raises ConfigError if something is there already, or if nothing can be written there.
    """
    require_free(directory)
    directory = Path(directory).absolute()
    # Not by the process's number: in a container that is the one that a killed process had, which left its directory.
    aside = directory.with_name(f".{directory.name}.{secrets.token_hex(4)}.tmp")
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        aside.mkdir()
    except OSError as error:
        raise unwritable(directory, error) from error
    try:
        yield aside
        os.replace(aside, directory)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
