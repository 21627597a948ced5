"""ArrayRecord files as tfds writes them under `--file_format=array_record`: records by their number.

Owns the difference to TFRecord files, with the same two functions as `tfrecord`. A record's place is
its number; its bytes are compressed and verified by the library, and their number is not known before.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import CorruptRecordError, UnreachableError
from data_pipelines.sources.rlds.location import is_remote, missing_shard, open_random_access, retry
from data_pipelines.sources.rlds.tfrecord import ShardIndex
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # for random access

ENDS = 65536
"""Bytes at each end of a file that stand for its contents: the last hold the place of every record."""

MAX_OPEN_FILES = 128
"""Files that are kept open between reads."""


def scan_shard(path: Location) -> tuple[ShardIndex, CorruptRecordError | None]:
    """The number of each record, and for all of them the file's mean length and one checksum of its ends.

    Raises ConfigError for a remote file, DataError for one that is missing or cannot be read.
    """
    if is_remote(path):
        raise ConfigError(f"{path}: ArrayRecord files can be read only from a disk. Copy the dataset to a disk.")
    with open_random_access(path) as file:
        size = file.size
        ends = file.read(0, ENDS) + file.read(max(size - ENDS, 0), ENDS)
    try:
        records = _reader(path).num_records() if size else 0
    except RuntimeError as error:
        return _index(path, 0, 0, b""), _damage(path, 0, error)
    return _index(path, records, size, ends), None


@contextmanager
def open_record(path: Location, offset: int, length: int) -> Iterator[bytes]:
    """Record number `offset`, for the time of a `with`, as `tfrecord.open_record`. `length` is not used."""
    del length
    try:
        payload = _reader(path).read(offset, offset + 1)[0]  # of a list it would go through all records
    except (RuntimeError, IndexError) as error:
        raise _damage(path, offset, error) from error
    yield payload


def _reader(path: Path):
    try:
        status = retry(path, lambda: os.stat(path))
    except FileNotFoundError:
        raise missing_shard(path) from None
    return _opened(path, (status.st_size, status.st_mtime_ns))


@functools.lru_cache(MAX_OPEN_FILES)
def _opened(path: Path, stamp: tuple[int, int]):
    """One reader per version of a file."""
    from array_record.python import array_record_module

    del stamp
    return array_record_module.ArrayRecordReader(str(path), options=OPTIONS)


def _index(path: Location, records: int, size: int, ends: bytes) -> ShardIndex:
    checksum = int.from_bytes(hashlib.sha256(ends).digest()[:4], "little")
    return ShardIndex(
        path,
        np.arange(records, dtype=np.int64),
        np.full(records, size // max(records, 1), np.int64),
        np.full(records, checksum, np.uint32),
    )


def _damage(path: Location, number: int, error: Exception) -> CorruptRecordError:
    """What the library says of bytes; what the system says of a disk is raised."""
    if any(word in str(error) for word in ("Input/output error", "Stale", "timed out")):
        raise UnreachableError(f"{path}: cannot be read ({error}). Run the same command again.") from error
    return CorruptRecordError(path, number, f"the record with this number cannot be read ({error})")
