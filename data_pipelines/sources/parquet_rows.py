"""Rows of Parquet files. Only the columns and row groups that hold what is asked for are read.

Owns the cache of decoded columns. A row group is the smallest part of a column that can be read; writers make one
per episode, per hundred images or per file.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.location import is_io_error, retry

T = TypeVar("T")

ADVICE = "Download the dataset again, including its meta folder."

CACHE_BYTES = 64 * 2**20
"""Bytes of decoded columns in the cache. The row group that was read last stays, whatever its size."""

MAX_LAYOUTS = 256
"""Files whose layout is cached: some kilobytes each."""

MAX_UNPACKED, MAX_RATIO = 256 * 2**20, 32
"""A file with a row group that unpacks to more bytes than this, and to more than this many times the file's size, is
not read: a small file could take all memory. States of a robot that hardly moves compress to an eighth."""


@dataclass(frozen=True)
class _Layout:
    """The runs of equal values in a file's column of labels. `ends` int64 [row groups]: the number of rows up to and
    including each group."""

    columns: tuple[str, ...]
    ends: np.ndarray
    labels: np.ndarray  # [runs]: the value of each run
    starts: np.ndarray  # int64 [runs + 1]: first row of each run, and at the end the number of rows


class ParquetRows:
    """Reads columns of any files on demand. `label` is the integer column, such as the episode's, whose runs of equal
    values can be looked up.

    Thread-safe; pickles with an empty cache. Every method raises DataError for a file that is missing or damaged,
    UnreachableError for one that cannot be read.
    """

    def __init__(self, label: str):
        self._label, self._lock = label, threading.RLock()
        self._layouts: OrderedDict[Path, _Layout] = OrderedDict()
        self._groups: OrderedDict[tuple[Path, int], dict[str, Any]] = OrderedDict()  # by column
        self._cached_bytes = 0
        self.loaded = 0
        """Bytes of decoded columns that were read so far."""

    def __reduce__(self):
        return type(self), (self._label,)

    def columns(self, path: Path) -> tuple[str, ...]:
        return self._layout(path).columns

    def find(self, path: Path, label: int) -> tuple[int, int] | None:
        """(first row, number of rows) with this label; None if there are none, or if they are not contiguous."""
        layout = self._layout(path)
        at = np.flatnonzero(layout.labels == label)
        if len(at) != 1:
            return None
        first, end = layout.starts[at[0] : at[0] + 2].tolist()
        return first, end - first

    def read(self, path: Path, columns: Sequence[str], first: int, count: int) -> Any:
        """A pyarrow table of `count` rows, one at least, of `columns` that the file has."""
        import pyarrow as arrow

        with self._lock:
            ends = self._layout(path).ends
            begin, last = np.searchsorted(ends, [first, first + count - 1], side="right").tolist()
            cached = self._load(path, range(begin, last + 1), columns)
        pieces = []
        for group, found in cached.items():
            before = int(ends[group - 1]) if group else 0
            a, b = max(first - before, 0), min(first + count, int(ends[group])) - before
            pieces.append(arrow.table({name: found[name] for name in columns}).slice(a, b - a))
        return arrow.concat_tables(pieces)

    def _layout(self, path: Path) -> _Layout:
        with self._lock:
            if path not in self._layouts:
                self._layouts[path] = _reading(path, lambda: _read_layout(path, self._label))
                if len(self._layouts) > MAX_LAYOUTS:
                    self._layouts.popitem(last=False)
            self._layouts.move_to_end(path)
            return self._layouts[path]

    def _load(self, path: Path, groups: Sequence[int], columns: Sequence[str]) -> dict[int, dict[str, Any]]:
        """The `columns` of these row groups, from the cache or the file."""
        cached = {g: self._groups.setdefault((path, g), {}) for g in groups}
        missing = {g: [name for name in columns if name not in cached[g]] for g in groups}
        missing = {g: names for g, names in missing.items() if names}
        layout = self._layout(path)
        for g, found in (_reading(path, lambda: _read_groups(path, layout, missing)) if missing else {}).items():
            cached[g].update(found)
            size = sum(column.nbytes for column in found.values())
            self._cached_bytes, self.loaded = self._cached_bytes + size, self.loaded + size
        for g in groups:
            self._groups.move_to_end((path, g))
        while self._cached_bytes > CACHE_BYTES and len(self._groups) > 1:
            _, evicted = self._groups.popitem(last=False)
            self._cached_bytes -= sum(column.nbytes for column in evicted.values())
        return cached


def read_table(path: Path, columns: Collection[str]) -> Any:
    """All rows of a file, as a pyarrow table with those of `columns` that it has. Raises what `ParquetRows` raises."""

    def read() -> Any:
        with _open(path) as file:
            table = file.read(columns=list(columns))
        table.column_names  # noqa: B018  fails here if they are not text
        return table

    return _reading(path, read)


def _reading(path: Path, read: Callable[[], T]) -> T:
    import pyarrow as arrow

    def attempt() -> T:
        try:
            return read()
        except (OSError, ValueError, arrow.ArrowException) as error:
            if is_io_error(error):
                raise  # to be tried again
            reason = str(error).strip().partition("\n")[0]
            raise DataError(f"{path}: the table cannot be read ({reason}). {ADVICE}") from error

    return retry(path, attempt)


def _open(path: Path) -> Any:
    """The pyarrow.parquet.ParquetFile. Raises ValueError if, as its footer says, a row group unpacks to too much."""
    from pyarrow import parquet

    file, size = parquet.ParquetFile(path), path.stat().st_size
    # The sizes of single columns are not looked at: over some damaged footers, pyarrow's `column` ends the process.
    for g in range(file.num_row_groups):
        if (unpacked := file.metadata.row_group(g).total_byte_size) > max(MAX_UNPACKED, MAX_RATIO * size):
            raise ValueError(f"its {size:,} bytes unpack to {unpacked:,}")
    return file


def _read_layout(path: Path, label: str) -> _Layout:
    with _open(path) as file:
        rows = np.array([file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)], np.int64)
        columns = tuple(file.schema_arrow.names)
        values = np.asarray(file.read([label])[label]) if label in columns else np.zeros(0, np.int64)
    if (rows < 0).any() or len(values) not in (0, rows.sum()):
        raise ValueError(f"its row groups have {rows.tolist()} rows, but {label} has {len(values)}")
    starts = np.flatnonzero(np.append(True, values[1:] != values[:-1])[: len(values)])
    return _Layout(columns, np.cumsum(rows), values[starts], np.append(starts, len(values)))


def _read_groups(path: Path, layout: _Layout, wanted: dict[int, list[str]]) -> dict[int, dict[str, Any]]:
    found, rows = {}, np.diff(layout.ends, prepend=0)
    with _open(path) as file:
        for g, names in wanted.items():
            table = file.read_row_group(g, columns=names)
            if table.num_rows != rows[g]:
                raise ValueError(f"a row group of {rows[g]} rows has {table.num_rows}")
            found[g] = {name: table[name] for name in names}
    return found
