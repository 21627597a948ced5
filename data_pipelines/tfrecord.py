"""TFRecord files as random-access storage: index, read one record, write.

Owns the framing and its checksums. Does not know what is inside a record (see `example`).

A record is: length (uint64), checksum of the length (uint32), payload, checksum of the
payload (uint32), all little-endian. As lengths are known from the headers, a scan that skips
payloads gives the place of every record, and any record is then one `pread` away. Nothing
here keeps a file open, so readers pickle and are safe in threads.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import google_crc32c
import numpy as np

from data_pipelines.errors import CorruptRecordError, DataError

HEADER = 12  # bytes: length and its checksum
FOOTER = 4  # bytes: checksum of the payload


@dataclass(frozen=True)
class ShardIndex:
    """Where the records of one file are, and the checksums that stand behind them."""

    path: Path
    offsets: np.ndarray  # int64 [records]: first byte of the header
    lengths: np.ndarray  # int64 [records]: bytes of the payload
    checksums: np.ndarray  # uint32 [records]: of the payload, as stored, not verified

    def __len__(self) -> int:
        return len(self.offsets)


def masked_crc32c(data: bytes) -> int:
    """CRC-32C, rotated and offset as the TFRecord format asks."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def index_shard(path: str | Path) -> ShardIndex:
    """The place of every record, from a scan that skips the payloads.

    Raises CorruptRecordError where a header's checksum is wrong or the file ends inside a
    record; payload checksums are verified by `read_record`. A file of 0 bytes has 0 records.
    """
    index, damage = scan_shard(path)
    if damage is not None:
        raise damage
    return index


def scan_shard(path: str | Path) -> tuple[ShardIndex, CorruptRecordError | None]:
    """`index_shard` that returns what it could index, and what stopped it.

    After a damaged header the place of the next record is unknown, so the rest of the file
    is lost: records before it are indexed, nothing behind it.
    """
    path = Path(path)
    offsets: list[int] = []
    lengths: list[int] = []
    checksums: list[int] = []
    damage = None
    fd = _open(path)
    try:
        size = os.fstat(fd).st_size
        offset = 0
        header = os.pread(fd, HEADER, offset)
        while offset < size:
            if len(header) < HEADER:
                reason = f"the file ends inside a record header, at byte {size}"
                damage = CorruptRecordError(path, offset, reason)
                break
            length, crc = struct.unpack("<QI", header)
            if masked_crc32c(header[:8]) != crc:
                reason = "the checksum of the record's length does not match"
                damage = CorruptRecordError(path, offset, reason)
                break
            end = offset + HEADER + length + FOOTER
            if end > size:
                reason = f"the file is truncated: the record needs bytes up to {end}, the file has {size}"
                damage = CorruptRecordError(path, offset, reason)
                break
            between = os.pread(fd, FOOTER + HEADER, end - FOOTER)  # this footer, the next header
            offsets.append(offset)
            lengths.append(length)
            checksums.append(struct.unpack("<I", between[:FOOTER])[0])
            offset, header = end, between[FOOTER:]
    finally:
        os.close(fd)
    index = ShardIndex(
        path,
        np.asarray(offsets, np.int64),
        np.asarray(lengths, np.int64),
        np.asarray(checksums, np.uint32),
    )
    return index, damage


def read_record(file: str | Path, offset: int, length: int, verify: bool = True) -> bytes:
    """The payload of `length` bytes of the record that starts at byte `offset` of `file`.

    Raises CorruptRecordError if the file is shorter than its index says or, with `verify`,
    if the payload does not match its checksum.
    """
    fd = _open(Path(file))
    try:
        body = os.pread(fd, length + FOOTER, offset + HEADER)
    except OSError as error:
        raise CorruptRecordError(file, offset, f"it cannot be read ({error.strerror})") from error
    finally:
        os.close(fd)
    if len(body) < length + FOOTER:
        raise CorruptRecordError(file, offset, "the file has become shorter since it was indexed")
    payload = body[:length]
    if verify and masked_crc32c(payload) != struct.unpack("<I", body[length:])[0]:
        raise CorruptRecordError(file, offset, "the checksum of the record's data does not match")
    return payload


def write_shard(path: str | Path, records: Iterable[bytes]) -> int:
    """Writes `records` as one TFRecord file and returns their number.

    The file appears under its name only when it is complete.
    """
    path = Path(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count = 0
    try:
        with open(aside, "wb") as out:
            for record in records:
                length = struct.pack("<Q", len(record))
                out.write(length + struct.pack("<I", masked_crc32c(length)))
                out.write(record)
                out.write(struct.pack("<I", masked_crc32c(record)))
                count += 1
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
    return count


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        raise DataError(f"{path}: the shard is missing. Fetch it again, or check the path.") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}.") from error
