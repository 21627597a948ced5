"""Directories that commands write into: made before any work, or refused in words that say what to do.

And files in them that are written anew in one go.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from hma_jax.config import ConfigError


def make_directory(directory: Path, option: str = "--out") -> None:
    """Makes `directory`, if it is not there, and sees that files can be written in it.

    Raises ConfigError otherwise; `option` is what the user chose it with.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise unwritable(directory, error, option) from error


def replace_file(path: Path, text: str) -> None:
    """A reader sees the old text or the new one, also after a crash or a loss of power. Raises OSError."""
    aside = path.with_name(f".{path.name}.tmp")
    with open(aside, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(aside, path)


def unwritable(directory: Path, error: OSError, option: str = "--out") -> ConfigError:
    """That `directory` cannot be made or written in: which directory above it, or which file, is in the way."""
    there = next(p for p in (directory, *directory.parents) if os.path.exists(p))
    what = f"nothing can be written in {there}" if there.is_dir() else f"{there} is a file"
    return ConfigError(
        f"cannot write to {directory}: {what} ({error.strerror}); choose another {option}, in a directory where you "
        "may write"
    )
