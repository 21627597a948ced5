"""Directories that commands write into: made before any work, or refused in words that say what to do."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from hma_jax.config import ConfigError


def make_directory(directory: Path, option: str | None = "--out") -> None:
    """Makes `directory`, if it is not there, and sees that files can be written in it.

    Raises ConfigError otherwise; `option` is what the user chose it with, None where it is what the command is about.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise unwritable(directory, error, option) from error


def unwritable(directory: Path, error: OSError, option: str | None = "--out") -> ConfigError:
    """That `directory` cannot be made or written in: which directory above it, or which file, is in the way."""
    there = next(p for p in (directory, *directory.parents) if os.path.exists(p))
    what = f"nothing can be written in {there}" if there.is_dir() else f"{there} is a file"
    advice = f"{f'choose another {option}, in' if option else 'copy it to'} a directory where you may write"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        advice = "make room on its disk"
    return ConfigError(f"cannot write to {directory}: {what} ({error.strerror}); {advice}")
