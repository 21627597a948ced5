"""Checks of a Parquet file's footer and page headers, made before a library allocates what they state.

A page header states the page's uncompressed size, in up to 31 bits, and readers allocate that much at once: a damaged
file of 800 bytes made pyarrow allocate 520 MB. Page headers and the footer, which lists their offsets, are structs of
Thrift's compact protocol (https://github.com/apache/parquet-format). pyarrow can read the footer too, but some
damaged ones abort the process.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, BinaryIO

MAX_UNCOMPRESSED = 32 * 2**20
"""Largest number of bytes of a page, uncompressed. Writers aim at 1 MB, but check the size after every thousand rows
only."""

MAX_COMPRESSION_RATIO = 8
"""A page may exceed MAX_UNCOMPRESSED up to this ratio to its compressed size: a thousand images hardly compress."""

MAX_HEADER = 64 * 1024
"""Bytes of a page header, which may hold the smallest and the largest value of its page."""

MAGIC, FOOTER_TAIL = b"PAR1", 8
"""The last 8 bytes of a file: the footer's length, in four bytes, and the magic."""

# Thrift field ids in FileMetaData, RowGroup, ColumnChunk, ColumnMetaData and PageHeader.
ROW_GROUPS, COLUMNS, ROWS, META = 4, 1, 3, 3
PATH_IN_SCHEMA, COMPRESSED_CHUNK_SIZE, DATA_PAGE_OFFSET, DICTIONARY_PAGE_OFFSET = 3, 7, 9, 11
UNCOMPRESSED_SIZE, COMPRESSED_SIZE = 2, 3

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
MAX_DEPTH = 12


Chunk = tuple[int, int]
"""A column chunk, what a row group holds of one leaf column: its first byte and its length in bytes."""


@dataclass(frozen=True)
class RowGroup:
    """A row group: its number of rows, and the chunks of each top-level column."""

    rows: int
    columns: dict[str, list[Chunk]]


def read_groups(file: BinaryIO) -> list[RowGroup]:
    """The row groups that the footer lists. Raises ValueError for a damaged footer."""
    groups = []
    for group in _structs(_read_footer(file), ROW_GROUPS):
        columns: dict[str, list[Chunk]] = {}
        for column in _structs(group, COLUMNS):
            meta = column.get(META)
            if not isinstance(meta, dict):
                raise ValueError("the footer does not describe a column")
            columns.setdefault(_column(meta), []).append(_chunk(meta))
        groups.append(RowGroup(_number(group, ROWS), columns))
    return groups


def check_pages(file: BinaryIO, chunks: Iterable[Chunk]) -> None:
    """Raises ValueError for a page of `chunks` whose header is damaged, that reaches out of its chunk or the file, or
    that states an uncompressed size above both MAX_UNCOMPRESSED and MAX_COMPRESSION_RATIO times its compressed size."""
    whole = file.seek(0, 2)
    for start, size in chunks:
        at, end = start, start + size
        if end > whole:
            raise ValueError(f"a column reaches to byte {end}, but the file has {whole} bytes")
        while at < end:
            file.seek(at)
            header = _Compact(file.read(min(MAX_HEADER, end - at)))
            sizes = header.read_struct()
            uncompressed, compressed = _number(sizes, UNCOMPRESSED_SIZE), _number(sizes, COMPRESSED_SIZE)
            limit = max(MAX_UNCOMPRESSED, MAX_COMPRESSION_RATIO * compressed)
            after = at + header.at + compressed
            if compressed < 0 or after > end:
                raise ValueError(f"a page of {compressed} bytes reaches beyond its column, which ends at byte {end}")
            if not 0 <= uncompressed <= limit:
                raise ValueError(
                    f"the page at byte {at} says that it holds {uncompressed} bytes, but {limit} is the largest size"
                )
            at = after


def _read_footer(file: BinaryIO) -> dict[int, Any]:
    size = file.seek(0, 2)
    file.seek(max(size - FOOTER_TAIL, 0))
    end = file.read(FOOTER_TAIL)
    length = int.from_bytes(end[:4], "little")
    if end[4:] != MAGIC or length > size - FOOTER_TAIL - len(MAGIC):
        raise ValueError("it does not end like a Parquet file")
    file.seek(size - FOOTER_TAIL - length)
    return _Compact(file.read(length)).read_struct()


def _column(meta: dict[int, Any]) -> str:
    """The top-level column of a leaf column, such as a field of a struct or the items of a list; "" if unknown."""
    place = meta.get(PATH_IN_SCHEMA)
    first = place[0] if isinstance(place, list) and place else b""
    return first.decode(errors="replace") if isinstance(first, bytes) else ""


def _chunk(meta: dict[int, Any]) -> Chunk:
    starts = [at for at in (_number(meta, DATA_PAGE_OFFSET), _number(meta, DICTIONARY_PAGE_OFFSET)) if at > 0]
    return min(starts, default=0), _number(meta, COMPRESSED_CHUNK_SIZE)


def _structs(values: dict[int, Any], field: int) -> list[dict[int, Any]]:
    found = values.get(field, [])
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise ValueError(f"the footer's field {field} is not a list of structs")
    return found


def _number(values: dict[int, Any], field: int) -> int:
    """An integer field; -1 if it is absent."""
    found = values.get(field)
    return found if isinstance(found, int) else -1


class _Compact:
    """A reader of Thrift's compact protocol; `at` is its position in the bytes. Raises ValueError."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def read_struct(self, depth: int = 0) -> dict[int, Any]:
        """Field id -> value; booleans, which nothing here needs, become None."""
        fields: dict[int, Any] = {}
        field = 0
        while (byte := self._byte()) != 0:
            delta, kind = byte >> 4, byte & 15
            field = field + delta if delta else self._integer()
            # A boolean field has no bytes of its own: its type says true or false.
            fields[field] = None if kind in (TRUE, FALSE) else self._read(kind, depth)
        return fields

    def _read(self, kind: int, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise ValueError("it is nested too deeply")
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
        raise ValueError(f"unknown kind of field, {kind}")

    def _byte(self) -> int:
        self._pass(1)
        return self.data[self.at - 1]

    def _pass(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("the footer or a header is cut off")

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
