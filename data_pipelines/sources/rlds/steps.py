"""A cache of each episode's number of steps, which is known only after its record was read.

Owns a file beside the index (see `index`). It may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.columns import Columns, write_columns
from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.index import RecordIndex, exclusive_lock, index_path, read_index

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


def known_mean_steps(directory: Location, split: str, episodes: int) -> float:
    """Mean number of steps of the episodes whose records were read before on this machine; 0 if there are none, or if
    the index has another number of `episodes`. Reads no shard."""
    path = index_path(directory, split)
    index = read_index(path)
    if index is None or len(index) != episodes:
        return 0.0
    steps = load_steps(path, index)
    return float(steps[steps >= 0].mean()) if (steps >= 0).any() else 0.0


def load_steps(path: Path, index: RecordIndex) -> np.ndarray:
    """int32 [records], -1 where unknown; `path` is that of the index."""
    try:
        columns = Columns(_steps_path(path))
        if columns.facts["index"] == _identity(index):
            return np.array(columns["steps"], np.int32)
    except (OSError, DataError, KeyError, TypeError):
        pass
    return np.full(len(index), -1, np.int32)


def save_steps(path: Path, index: RecordIndex, steps: np.ndarray) -> None:
    """Saves `steps`, merged with what other processes have saved meanwhile."""
    try:
        with exclusive_lock(_steps_path(path)):
            kept = load_steps(path, index)
            merged = np.where(steps >= 0, steps, kept).astype(np.int32)
            if not np.array_equal(merged, kept):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_columns(_steps_path(path), {"index": _identity(index)}, {"steps": merged})
    except OSError as error:
        warnings.warn(f"{_steps_path(path)}: cannot be written ({error.strerror or error}).", stacklevel=2)


def _steps_path(path: Path) -> Path:
    return path.with_suffix(".steps")


def _identity(index: RecordIndex) -> str:
    facts = "".join(f"{s.name}:{s.records}:{s.digest};" for s in index.shards)
    return hashlib.sha256(facts.encode()).hexdigest()[:32]
