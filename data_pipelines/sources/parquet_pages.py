"""What the pages of a Parquet file say they hold, looked at before a library takes memory for it.

A page's header states its size unpacked, in up to 31 bits, and a reader takes that much memory at once: a damaged
file of 800 bytes asked for 520 MB. Headers are structs of Thrift's compact protocol, one after another:
https://github.com/apache/parquet-format (PageHeader: 1 type, 2 uncompressed size, 3 compressed size, ...).
"""

from __future__ import annotations

from typing import BinaryIO

MOST_UNPACKED = 32 * 2**20
"""Bytes of a page, unpacked. Writers aim at 1 MB; a page of one large image may have more."""

MOST_HEADER = 64 * 1024
"""Bytes; a header may hold the smallest and the largest value of its page."""

UNCOMPRESSED, COMPRESSED = 2, 3
TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)


def check_pages(file: BinaryIO, start: int, size: int) -> None:
    """Looks at the headers of a column chunk's pages, `size` bytes from `start` on. Raises ValueError for one that
    is damaged, lies outside, or says that it holds more than MOST_UNPACKED bytes."""
    at, end = start, start + size
    while at < end:
        file.seek(at)
        header = _Header(file.read(min(MOST_HEADER, end - at)))
        sizes = header.read_struct()
        unpacked, packed = sizes.get(UNCOMPRESSED, -1), sizes.get(COMPRESSED, -1)
        if not 0 <= unpacked <= MOST_UNPACKED:
            raise ValueError(f"the page at byte {at} says that it holds {unpacked} bytes, {MOST_UNPACKED} are the most")
        at += header.at + packed
        if packed < 0 or at > end:
            raise ValueError(f"a page of {packed} bytes reaches out of its column, which ends at byte {end}")


class _Header:
    """Thrift's compact protocol, as much as a page header has of it."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def read_struct(self, depth: int = 0) -> dict[int, int]:
        """Field -> value, of its whole numbers; what else it has is passed over."""
        fields: dict[int, int] = {}
        field = 0
        while (byte := self._byte()) != 0:
            delta, kind = byte >> 4, byte & 15
            field = field + delta if delta else self._integer()
            if kind in (I16, I32, I64):
                fields[field] = self._integer()
            elif kind not in (TRUE, FALSE):  # which stand in the field's own byte
                self._skip(kind, depth)
        return fields

    def _skip(self, kind: int, depth: int) -> None:
        if depth > 8:
            raise ValueError("a page header is nested too deep")
        if kind in (TRUE, FALSE, BYTE):  # as an element of a list
            self._byte()
        elif kind in (I16, I32, I64):
            self._varint()
        elif kind == DOUBLE:
            self._pass(8)
        elif kind == BINARY:
            self._pass(self._varint())
        elif kind in (LIST, SET):
            byte = self._byte()
            for _ in range(self._varint() if byte >> 4 == 15 else byte >> 4):
                self._skip(byte & 15, depth + 1)
        elif kind == STRUCT:
            self.read_struct(depth + 1)
        else:
            raise ValueError(f"a page header has a field of kind {kind}")

    def _byte(self) -> int:
        self._pass(1)
        return self.data[self.at - 1]

    def _pass(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("a page header is cut off")

    def _varint(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 128:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise ValueError("a page header has a number of more than 64 bits")
        return value | byte << shift

    def _integer(self) -> int:
        """Zigzag: 0, -1, 1, -2, ..."""
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
