"""Arrays that stand beside a part's file of records: far smaller than the records, and needed more often.

Owns their files.
"""

from __future__ import annotations

import io
import os
import tokenize
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.publishing.files import sync
from data_pipelines.sources.rlds.location import retry


def write_beside(part: Path, kind: str, rows: np.ndarray, scratch: Path) -> None:
    """Writes `rows`, whole or not at all; `scratch` is a directory on the same disk. Raises OSError."""
    path = beside(part, kind)
    np.save(scratch / path.name, rows)
    sync(scratch / path.name)
    os.replace(scratch / path.name, path)


def read_beside(part: Path, kind: str, rows: int, dtype: type, of: str, advice: str) -> np.ndarray | None:
    """[rows, ...] of `dtype`; None if there is no such file beside `part`.

    For messages, `of` says what the rows are ("the actions of 12 steps") and `advice` what to do about a damaged file.
    Raises DataError for that, UnreachableError if the disk fails.
    """
    path = beside(part, kind)
    try:
        data = retry(path, path.read_bytes)  # numpy mistakes a disk that fails in the middle for a file that ends there
    except FileNotFoundError:
        return None
    try:
        found = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, TypeError, tokenize.TokenError) as error:  # the last one for a damaged header
        raise DataError(f"{path}: {of} cannot be read ({error}). {advice}") from error
    if found.ndim != 2 or len(found) != rows or found.dtype != dtype:
        raise DataError(f"{path}: {found.dtype} {list(found.shape)} cannot be {of}. {advice}")
    return found


def beside(part: Path, kind: str) -> Path:
    """The file; `part` is the part's file of records."""
    return part.with_suffix(f".{kind}.npy")
