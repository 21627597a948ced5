"""A file of named numpy columns: a small JSON header, then the arrays, which are memory-mapped on access.

Owns the file layout and its checksums, not the meaning of the columns. A file gets its name only
when it is complete, and every part of it is checked against its hash before it is used.

    8 bytes    magic, with the version of the layout
    8 bytes    length of the header, little-endian
    32 bytes   SHA-256 of the header
    header     JSON: {"facts": ..., "columns": {name: [dtype, entries, offset, SHA-256]}}
    columns    one-dimensional, little-endian, each at a multiple of 64 bytes
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from hma_jax.runtime.files import sync

MAGIC = b"HMACOLS1"
ALIGNMENT = 64
DTYPES = ("<i4", "<i8", "<u4", "<u8")
_START = len(MAGIC) + 8 + 32


def write_columns(path: Path, facts: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> None:
    """Writes `facts`, plain JSON values, and `columns`, arrays of one axis. Raises OSError."""
    table, arrays, end = {}, {}, 0
    for name, values in columns.items():
        array = np.ascontiguousarray(values)
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        if array.ndim != 1 or array.dtype.str not in DTYPES:
            raise ValueError(f"column {name!r} is {array.dtype.str} {list(array.shape)}; it must be one of {DTYPES}")
        digest = hashlib.sha256(array.data).hexdigest()
        at = _aligned(end) if array.nbytes else 0  # an empty one takes no space
        table[name], arrays[name] = [array.dtype.str, len(array), at, digest], array
        end = max(end, at + array.nbytes)
    header = json.dumps({"facts": facts, "columns": table}, sort_keys=True).encode()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "wb") as out:
            out.write(MAGIC + len(header).to_bytes(8, "little") + hashlib.sha256(header).digest() + header)
            begin = _aligned(_START + len(header))
            for name, array in arrays.items():
                out.seek(begin + table[name][2])
                out.write(array.data)
            out.truncate(begin + end)
            out.flush()
            os.fsync(out.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


class Columns:
    """A file that `write_columns` wrote. `facts` are read at once, `columns[name]` on access.

    Columns are read-only views of the memory-mapped file, whose pages the kernel may evict and read again.
    Raises OSError if the file is missing, DataError if it is damaged.
    """

    def __init__(self, path: Path):
        self.path = path
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            start = file.read(_START)
            if len(start) < _START or start[: len(MAGIC)] != MAGIC:
                raise self._damaged("it does not begin like such a file")
            length = int.from_bytes(start[len(MAGIC) : len(MAGIC) + 8], "little")
            header = file.read(min(length, size))
        if hashlib.sha256(header).digest() != start[-32:]:
            raise self._damaged("its header does not match its hash")
        try:
            values = json.loads(header)
            self.facts: dict[str, Any] = values["facts"]
            self._table = {name: (str(d), int(n), int(at), str(h)) for name, (d, n, at, h) in values["columns"].items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._damaged(f"its header is not a table ({error})") from error
        self._begin, self._size = _aligned(_START + length), size
        self._mapped: dict[str, np.ndarray] = {}

    def digest(self, name: str) -> str:
        """SHA-256 of a column as it was written, without reading it."""
        return self._entry(name)[3]

    def entries(self, name: str) -> int:
        """Number of entries of a column, without reading it."""
        return self._entry(name)[1]

    def __getitem__(self, name: str) -> np.ndarray:
        """A column, verified on first access. Raises DataError if it is damaged or missing."""
        if name not in self._mapped:
            dtype, count, at, digest = self._entry(name)
            nbytes = count * int(dtype[-1]) if dtype in DTYPES else -1
            if nbytes < 0 or count < 0 or at < 0 or self._begin + at + nbytes > self._size:
                raise self._damaged(f"its column {name!r} reaches beyond the end of the file")
            if count:
                array = np.memmap(self.path, dtype, "r", self._begin + at, (count,)).view(np.ndarray)
            else:
                array = np.zeros(0, dtype)
            if hashlib.sha256(array.data).hexdigest() != digest:
                raise self._damaged(f"its column {name!r} does not match its hash")
            self._mapped[name] = array
        return self._mapped[name]

    def _entry(self, name: str) -> tuple[str, int, int, str]:
        if name not in self._table:
            raise self._damaged(f"it has no column {name!r}")
        return self._table[name]

    def _damaged(self, reason: str) -> DataError:
        return DataError(f"{self.path}: damaged: {reason}.")


class Column(Sequence[int]):
    """Integers with the interface of a tuple, stored as one array. A column of a file is read on first use."""

    def __init__(self, values: Iterable[int] | np.ndarray = (), dtype: str = "<i4"):
        array = values if isinstance(values, np.ndarray) else np.fromiter(values, np.int64)
        self._array: np.ndarray | None = array.astype(dtype)
        if array.ndim != 1 or not np.array_equal(self._array, array):
            raise ValueError(f"{array.dtype} {list(array.shape)} is not a column of {dtype}")
        self._lazy: tuple[Columns, str] | None = None

    @classmethod
    def of(cls, columns: Columns, name: str) -> Column:
        """A column of a file, read and verified on first use."""
        made = cls.__new__(cls)
        made._array, made._lazy = None, (columns, name)
        return made

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        array = self._lazy[0][self._lazy[1]] if self._array is None else self._array
        array = array if dtype is None else array.astype(dtype, copy=False)
        return array.copy() if copy else array

    def __len__(self) -> int:
        return len(self._array) if self._lazy is None else self._lazy[0].entries(self._lazy[1])

    def __getitem__(self, i):
        found = np.asarray(self)[i]
        return Column(found) if isinstance(i, slice) else int(found)

    def __iter__(self) -> Iterator[int]:
        return iter(np.asarray(self).tolist())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, (Column, tuple)) and np.array_equal(np.asarray(self), np.asarray(other))

    def __hash__(self) -> int:
        return hash(self.digest())

    def __repr__(self) -> str:
        return f"Column of {len(self):,}"

    def __reduce__(self):
        return Column, (np.asarray(self),)

    def digest(self) -> str:
        """SHA-256 of the entries; for a column of a file, the hash recorded when it was written, without reading it."""
        if self._lazy is not None:
            return self._lazy[0].digest(self._lazy[1])
        return hashlib.sha256(self._array.data).hexdigest()


def _aligned(at: int) -> int:
    return -(-at // ALIGNMENT) * ALIGNMENT
