"""What the pages of a Parquet file say they hold, looked at before a library takes memory for it.

A page's header states its size unpacked, in up to 31 bits, and a reader takes that much memory at once: a damaged
file of 800 bytes asked for 520 MB. Headers, and the file's footer that says where they lie, are structs of Thrift's
compact protocol (https://github.com/apache/parquet-format). pyarrow shows the footer too, but ends the process
over some that are damaged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, BinaryIO

MOST_UNPACKED = 32 * 2**20
"""Bytes of any page, unpacked. Writers aim at 1 MB, but look after a thousand rows only."""

MOST_TIMES = 8
"""As many times the bytes that a page takes in the file, it may have too: a thousand images are hardly packed."""

MOST_HEADER = 64 * 1024
"""Bytes; a header may hold the smallest and the largest value of its page."""

MAGIC, END = b"PAR1", 8
"""A file ends with the footer's length, in four bytes, and the magic."""

# Fields of FileMetaData, RowGroup, ColumnChunk, ColumnMetaData and PageHeader.
ROW_GROUPS, COLUMNS, ROWS, META = 4, 1, 3, 3
PLACE, CHUNK_SIZE, DATA_AT, DICTIONARY_AT, UNPACKED, PACKED = 3, 7, 9, 11, 2, 3

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
DEEPEST = 12


Chunk = tuple[int, int]
"""First byte and bytes of what a group of rows holds of a column, or of one field of it."""


@dataclass(frozen=True)
class RowGroup:
    """Rows that lie together: how many, and where each column of theirs does."""

    rows: int
    columns: dict[str, list[Chunk]]


def read_groups(file: BinaryIO) -> list[RowGroup]:
    """What the footer says. Raises ValueError for one that is damaged."""
    groups = []
    for group in _structs(_read_footer(file), ROW_GROUPS):
        columns: dict[str, list[Chunk]] = {}
        for column in _structs(group, COLUMNS):
            meta = column.get(META)
            if not isinstance(meta, dict):
                raise ValueError("the footer says of a column nothing")
            columns.setdefault(_column(meta), []).append(_chunk(meta))
        groups.append(RowGroup(_number(group, ROWS), columns))
    return groups


def check_pages(file: BinaryIO, chunks: Iterable[Chunk] | None = None) -> None:
    """Raises ValueError for a page of `chunks`, by default of all, that is damaged, lies outside of its column or of
    the file, or says that it holds more than MOST_UNPACKED bytes and MOST_TIMES its own."""
    if chunks is None:
        chunks = [chunk for group in read_groups(file) for column in group.columns.values() for chunk in column]
    whole = file.seek(0, 2)
    for start, size in chunks:
        at, end = start, start + size
        if end > whole:
            raise ValueError(f"a column reaches to byte {end}, the file has {whole}")
        while at < end:
            file.seek(at)
            header = _Compact(file.read(min(MOST_HEADER, end - at)))
            sizes = header.read_struct()
            unpacked, packed = _number(sizes, UNPACKED), _number(sizes, PACKED)
            most = max(MOST_UNPACKED, MOST_TIMES * packed)
            after = at + header.at + packed
            if packed < 0 or after > end:
                raise ValueError(f"a page of {packed} bytes reaches out of its column, which ends at byte {end}")
            if not 0 <= unpacked <= most:
                raise ValueError(f"the page at byte {at} says that it holds {unpacked} bytes, {most} are the most")
            at = after


def _read_footer(file: BinaryIO) -> dict[int, Any]:
    size = file.seek(0, 2)
    file.seek(max(size - END, 0))
    end = file.read(END)
    length = int.from_bytes(end[:4], "little")
    if end[4:] != MAGIC or length > size - END - len(MAGIC):
        raise ValueError("it does not end as a Parquet file does")
    file.seek(size - END - length)
    return _Compact(file.read(length)).read_struct()


def _column(meta: dict[int, Any]) -> str:
    """The column that a part of it, a field of a struct or what a list holds, belongs to; "" if it does not say."""
    place = meta.get(PLACE)
    first = place[0] if isinstance(place, list) and place else b""
    return first.decode(errors="replace") if isinstance(first, bytes) else ""


def _chunk(meta: dict[int, Any]) -> Chunk:
    starts = [at for at in (_number(meta, DATA_AT), _number(meta, DICTIONARY_AT)) if at > 0]
    return min(starts, default=0), _number(meta, CHUNK_SIZE)


def _structs(values: dict[int, Any], field: int) -> list[dict[int, Any]]:
    found = values.get(field, [])
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise ValueError(f"the footer's field {field} is no list of structs")
    return found


def _number(values: dict[int, Any], field: int) -> int:
    """A whole number, -1 where there is none."""
    found = values.get(field)
    return found if isinstance(found, int) else -1


class _Compact:
    """Thrift's compact protocol: values from bytes, and in `at` how many were read. Raises ValueError."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def read_struct(self, depth: int = 0) -> dict[int, Any]:
        """Field -> value; of truth values None."""
        fields: dict[int, Any] = {}
        field = 0
        while (byte := self._byte()) != 0:
            delta, kind = byte >> 4, byte & 15
            field = field + delta if delta else self._integer()
            # A field's own byte says whether it is true.
            fields[field] = None if kind in (TRUE, FALSE) else self._read(kind, depth)
        return fields

    def _read(self, kind: int, depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError("it is nested too deep")
        if kind in (I16, I32, I64):
            return self._integer()
        if kind in (TRUE, FALSE, BYTE):
            return self._pass(1)
        if kind == DOUBLE:
            return self._pass(8)
        if kind == BINARY:
            count = self._varint()
            self._pass(count)
            return self.data[self.at - count : self.at]
        if kind in (LIST, SET):
            byte = self._byte()
            count = byte >> 4
            return [self._read(byte & 15, depth + 1) for _ in range(self._varint() if count == 15 else count)]
        if kind == STRUCT:
            return self.read_struct(depth + 1)
        raise ValueError(f"a field of kind {kind} is not known")

    def _byte(self) -> int:
        self._pass(1)
        return self.data[self.at - 1]

    def _pass(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("footer or header are cut off")

    def _varint(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 128:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise ValueError("a number has more than 64 bits")
        return value | byte << shift

    def _integer(self) -> int:
        """Zigzag: 0, -1, 1, -2, ..."""
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
