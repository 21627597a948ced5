"""TFRecord files as random-access storage: index, read one record, write.

Owns the framing and its checksums. Does not know what is inside a record (see `example`).

A record is: length (uint64), checksum of the length (uint32), payload, checksum of the
payload (uint32), all little-endian. Since the headers give the lengths, a scan that skips payloads finds the offset of
every record, and reading any record then takes one read. Records of hundreds of megabytes are never held in memory as a
whole: their checksum is computed in pieces, and bytes are read on access. Nothing here keeps a file open beyond a call
or a `with`; callers that read small parts again and again pass an open file (see `location.OpenFiles`).
"""

from __future__ import annotations

import os
import struct
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import google_crc32c
import numpy as np

from data_pipelines.errors import CorruptRecordError, DataError, UnreachableError
from data_pipelines.sources.rlds.location import Descriptor, RandomAccessFile, is_remote, open_random_access
from hma_jax.runtime.files import naming

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

HEADER = 12  # bytes: length and its checksum
FOOTER = 4  # bytes: checksum of the payload

MAX_WHOLE_READ = 16 * 2**20
"""Records up to this many bytes are read as a whole, larger ones on access."""

CHUNK = 4 * 2**20
"""Bytes of a large record in memory at a time while its checksum is computed."""

BLOCK = 4096
"""Smallest read in bytes: the bytes asked for next are usually among them."""

COMPRESSED = (b"\x1f\x8b", b"\x78\x01", b"\x78\x9c", b"\x78\xda")
"""How a file begins that TensorFlow wrote with compression GZIP or ZLIB."""

SMALL, SCAN_BLOCK = 4096, 65536
"""A scan reads through records of up to SMALL bytes in blocks of SCAN_BLOCK, and skips larger ones."""

REMOTE_SMALL, REMOTE_BLOCK = 256 * 2**10, 4 * 2**20
"""The same for a remote shard, where a request costs as much time as a megabyte."""


@dataclass(frozen=True)
class ShardIndex:
    """Offsets, lengths and stored checksums of the records of one file."""

    path: Location
    offsets: np.ndarray  # int64 [records]: first byte of the header
    lengths: np.ndarray  # int64 [records]: bytes of the payload
    checksums: np.ndarray  # uint32 [records]: of the payload, as stored, not verified

    def __len__(self) -> int:
        return len(self.offsets)


def masked_crc32c(data: bytes) -> int:
    """CRC-32C, rotated and offset as the TFRecord format asks."""
    return _mask(google_crc32c.value(data))


def _mask(crc: int) -> int:
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def scan_shard(path: Location) -> tuple[ShardIndex, CorruptRecordError | None]:
    """The index of a file, from a scan that skips the payloads, and the error that stopped it.

    It stops where a header's checksum is wrong or the file ends inside a record: the offset of the next record is then
    unknown, so records before it are indexed and the rest of the file is not. Payload checksums are verified by
    `read_record`. A file of 0 bytes has 0 records. A file that cannot be read raises UnreachableError, which is not
    damage; a compressed one raises DataError. The scan reads block by block: a block holds many records if they are
    small, little more than a header if they are large.
    """
    offsets: list[int] = []
    lengths: list[int] = []
    checksums: list[int] = []
    damage = None
    with open_random_access(path) as file:
        size = file.size
        small, block = (REMOTE_SMALL, REMOTE_BLOCK) if is_remote(path) else (SMALL, SCAN_BLOCK)
        view = FileView(file, 0, size, SCAN_BLOCK if is_remote(path) else BLOCK)
        offset = 0
        header = view[:HEADER]
        while offset < size:
            if len(header) < HEADER:
                reason = f"the file ends inside a record header, at byte {size}"
                damage = CorruptRecordError(path, offset, reason)
                break
            length, crc = struct.unpack("<QI", header)
            if masked_crc32c(header[:8]) != crc:
                if not offset and header[:2] in COMPRESSED:
                    raise DataError(
                        f"{path}: it is compressed with GZIP or ZLIB, so single records cannot be read. Write it again "
                        "without compression, under the same name (GZIP: gunzip < OLD > NEW)."
                    )
                reason = "the checksum of the record's length does not match"
                damage = CorruptRecordError(path, offset, reason)
                break
            end = offset + HEADER + length + FOOTER
            if end > size:
                reason = f"the file is truncated: the record ends at byte {end}, but the file has {size} bytes"
                damage = CorruptRecordError(path, offset, reason)
                break
            view.block = block if length <= small else FOOTER + HEADER
            between = view[end - FOOTER : end + HEADER]  # this footer, the next header
            offsets.append(offset)
            lengths.append(length)
            checksums.append(struct.unpack("<I", between[:FOOTER])[0])
            offset, header = end, between[FOOTER:]
    index = ShardIndex(
        path,
        np.asarray(offsets, np.int64),
        np.asarray(lengths, np.int64),
        np.asarray(checksums, np.uint32),
    )
    return index, damage


def read_record(path: Location, offset: int, length: int) -> bytes:
    """The payload of `length` bytes of the record that starts at byte `offset` of `path`.

    Raises CorruptRecordError if the file is shorter than its index says or if the payload does not match its checksum.
    """
    with open_random_access(path) as file:
        body = _read(file, path, offset, offset + HEADER, length + FOOTER)
    payload = body[:length]
    _verify(masked_crc32c(payload), body[length:], path, offset)
    return payload


def read_parts(file: RandomAccessFile, path: Location, offset: int, spans: Iterable[tuple[int, int]]) -> list[bytes]:
    """Bytes [start, end) of the payload of a record in an open file; the record was verified before.

    Raises CorruptRecordError, which names `path`, if the file has become shorter.
    """
    return [_read(file, path, offset, offset + HEADER + start, end - start) for start, end in spans]


@contextmanager
def open_record(path: Location, offset: int, length: int) -> Iterator[bytes | FileView]:
    """The verified payload of a record, within a `with` block, in bounded memory.

    Up to MAX_WHOLE_READ bytes it is read at once. A larger payload is verified in pieces and given as a view that reads
    on access; from a remote store it passes through an unnamed temporary file, so that every byte is fetched
    once. Raises CorruptRecordError as `read_record` does, UnreachableError if there is no room for that file.
    """
    if length <= MAX_WHOLE_READ:
        yield read_record(path, offset, length)
        return
    with open_random_access(path) as file:
        footer = _read(file, path, offset, offset + HEADER + length, FOOTER)
        if not is_remote(path):
            _verify(_stream(file, path, offset, length, None), footer, path, offset)
            yield FileView(file, offset + HEADER, length)
            return
        crc, copy = _copy_to_disk(file, path, offset, length)
        with copy:
            _verify(crc, footer, path, offset)
            yield FileView(Descriptor(copy.fileno()), 0, length)


class FileView:
    """A part of an open file that is indexed and sliced like `bytes`, and read on access.

    Not thread-safe: it caches the block read last. `block` is the smallest read in bytes and may be changed
    between reads.
    """

    def __init__(self, file: RandomAccessFile, start: int, length: int, block: int = BLOCK):
        self._file, self._start, self._length, self.block = file, start, length, block
        self._at, self._block = 0, b""

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, key: int | slice):
        """An int for a position, `bytes` for a slice without a step; no negative positions."""
        if isinstance(key, slice):
            begin, end, _ = key.indices(self._length)
            return self._bytes(begin, max(end - begin, 0))
        if not 0 <= key < self._length:
            raise IndexError(f"byte {key} of {self._length}")
        return self._bytes(key, 1)[0]

    def _bytes(self, at: int, count: int) -> bytes:
        first = at - self._at
        if first < 0 or first + count > len(self._block):
            if count >= self.block:
                return self._file.read(self._start + at, count)
            self._block = self._file.read(self._start + at, min(self.block, self._length - at))
            self._at, first = at, 0
        return self._block[first : first + count]


def _read(file: RandomAccessFile, path: Location, record: int, at: int, length: int) -> bytes:
    """Exactly `length` bytes of the record that starts at byte `record`."""
    data = file.read(at, length)
    if len(data) < length:
        raise CorruptRecordError(path, record, "the file has become shorter since it was indexed")
    return data


def _stream(file: RandomAccessFile, path: Location, offset: int, length: int, copy) -> int:
    """The masked checksum of a payload, read in pieces that are also written to `copy`."""
    crc, at = 0, offset + HEADER
    for begin in range(at, at + length, CHUNK):
        piece = _read(file, path, offset, begin, min(CHUNK, at + length - begin))
        crc = google_crc32c.extend(crc, piece)
        if copy is not None:
            copy.write(piece)
    return _mask(crc)


def _copy_to_disk(file: RandomAccessFile, path: Location, offset: int, length: int) -> tuple[int, IO[bytes]]:
    """The masked checksum of a payload, and a temporary file that holds it."""
    try:
        with ExitStack() as closing:
            copy = closing.enter_context(tempfile.TemporaryFile())
            crc = _stream(file, path, offset, length, copy)
            copy.flush()
            closing.pop_all()
            return crc, copy
    except OSError as error:  # caught here, not in the caller, which may be writing files of its own
        where = tempfile.tempdir or "the temporary directory"
        raise UnreachableError(
            f"{where}: the record at byte {offset} of {path}, {length} bytes, cannot be kept there while it is read "
            f"({error.strerror or error}). Set TMPDIR to a directory on a disk with space, and run the same command "
            "again."
        ) from error


def _verify(crc: int, footer: bytes, path: Location, offset: int) -> None:
    if crc != struct.unpack("<I", footer)[0]:
        raise CorruptRecordError(path, offset, "the checksum of the record's data does not match")


def write_shard(path: Path, records: Iterable[bytes]) -> int:
    """Writes `records` as one TFRecord file and returns their number.

    The file appears under its name only when it is complete. Raises OSError, which names it.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count = 0
    try:
        with naming(path), open(temporary, "wb") as out:
            for record in records:
                length = struct.pack("<Q", len(record))
                out.write(length + struct.pack("<I", masked_crc32c(length)))
                out.write(record)
                out.write(struct.pack("<I", masked_crc32c(record)))
                count += 1
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def payload_bytes(path: Path, records: int) -> int:
    """Bytes of the payloads of a file with this number of records: what tfds counts as its size."""
    return path.stat().st_size - (HEADER + FOOTER) * records
