"""Files of arrays (.npz): atomic writes, and one error for all kinds of damage."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hma_jax.config import ConfigError
from hma_jax.runtime.files import write_file

UNREADABLE = (
    OSError, ValueError, KeyError, IndexError, TypeError, EOFError, RuntimeError,
    zipfile.BadZipFile, zlib.error, tokenize.TokenError,
)  # fmt: skip
"""What numpy raises for a file that is missing or damaged, or lacks an array: RuntimeError where a flipped bit
indicates encryption or an unknown compression, EOFError for an empty file, TokenError for a damaged header of an
array."""


def write_arrays(path: Path | str, arrays: Mapping[str, Any], compressed: bool = True) -> None:
    """Replaces the file. Raises OSError, in which case the old content stays."""
    content = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(content, **arrays)
    write_file(path, content.getvalue())


@contextmanager
def reading_arrays(path: Path | str, advice: str) -> Iterator[Mapping[str, np.ndarray]]:
    """The arrays of a file, while the block runs. Errors of the block in UNREADABLE count as damage too. Raises
    ConfigError, which ends with `advice`, if the file is missing, damaged or not what the block expects."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except UNREADABLE as error:
        raise ConfigError(f"{path} cannot be read ({error}); {advice}") from error
