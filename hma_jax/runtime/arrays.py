"""Files of arrays (.npz): written whole or not at all, and damage told in words."""

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
"""What numpy raises for a file that is missing or damaged, and what comes of one that lacks an array: RuntimeError when
a flipped bit claims encryption or an unknown compression, EOFError for an empty file, TokenError for the header of an
array."""


def write_arrays(path: Path, arrays: Mapping[str, Any], compressed: bool = True) -> None:
    """Replaces the file. Raises OSError; the old content stays then."""
    content = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(content, **arrays)
    write_file(path, content.getvalue())


@contextmanager
def reading_arrays(path: Path, advice: str) -> Iterator[Mapping[str, np.ndarray]]:
    """The arrays of a file, for the block that makes something of them. Raises ConfigError, which ends with the
    `advice`, where the file is missing, damaged or of something else."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except UNREADABLE as error:
        raise ConfigError(f"{path} cannot be read ({error}); {advice}") from error
