"""Directories that commands write into: they are made before any work, or refused with a message that says what to
do."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_jax.config import ConfigError
from hma_jax.runtime.files import IO_ERRNOS


def make_directory(directory: Path, option: str | None = "--out") -> None:
    """Makes `directory` if it does not exist, and checks that files can be written in it.

    Raises ConfigError otherwise; `option` is the option with which the user chose it, None where the directory is the
    command's subject.
    """
    with writing_to(directory, option):
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass


@contextmanager
def writing_to(directory: Path, option: str | None = "--out") -> Iterator[None]:
    """Turns an OSError from the block into a ConfigError that says why `directory` cannot be made or written in: which
    directory above it, or which file, is in the way. Errors of a failing disk stay as they are: another directory would
    not help."""
    try:
        yield
    except OSError as error:
        if error.errno in IO_ERRNOS:
            raise
        there = next(p for p in (directory, *directory.parents) if os.path.exists(p))
        what = f"nothing can be written in {there}" if there.is_dir() else f"{there} is a file"
        advice = f"{f'choose another {option}, in' if option else 'copy it to'} a directory where you may write"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "make room on its disk"
        raise ConfigError(f"cannot write to {directory}: {what} ({error.strerror}); {advice}") from error
