"""ArrayRecord files as tfds writes them with `--file_format=array_record`: records by their number.

Owns the differences from TFRecord files, with the same two functions as `tfrecord`. A record's offset is its number;
the library decompresses and verifies its bytes, and their length is not known before they are read.
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

READ_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # for random access

SAMPLED_BYTES = 65536
"""Bytes at each end of a file that its checksum covers. The last bytes hold the offsets of all records."""

MAX_OPEN_FILES = 128
"""Files that are kept open between reads."""


def scan_shard(path: Location) -> tuple[ShardIndex, CorruptRecordError | None]:
    """The index of a file: the number of each record, and for all of them the mean length and a checksum of the ends.

    Raises ConfigError for a remote file, DataError for one that is missing or cannot be read.
    """
    if is_remote(path):
        raise ConfigError(f"{path}: ArrayRecord files can be read only from a disk. Copy the dataset to a disk.")
    with open_random_access(path) as file:
        size = file.size
        ends = file.read(0, SAMPLED_BYTES) + file.read(max(size - SAMPLED_BYTES, 0), SAMPLED_BYTES)
    try:
        records = _reader(path).num_records() if size else 0
    except RuntimeError as error:
        return _index(path, 0, 0, b""), _damage(path, 0, error)
    return _index(path, records, size, ends), None


@contextmanager
def open_record(path: Location, offset: int, length: int) -> Iterator[bytes]:
    """Record number `offset`, within a `with` block, like `tfrecord.open_record`. `length` is not used."""
    del length
    try:
        payload = _reader(path).read(offset, offset + 1)[0]  # given a list, the library would go through all records
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
    return array_record_module.ArrayRecordReader(str(path), options=READ_OPTIONS)


def _index(path: Location, records: int, size: int, ends: bytes) -> ShardIndex:
    checksum = int.from_bytes(hashlib.sha256(ends).digest()[:4], "little")
    return ShardIndex(
        path,
        np.arange(records, dtype=np.int64),
        np.full(records, size // max(records, 1), np.int64),
        np.full(records, checksum, np.uint32),
    )


def _damage(path: Location, number: int, error: Exception) -> CorruptRecordError:
    """The library's error as damage; an error of the disk is raised as UnreachableError."""
    if any(word in str(error) for word in ("Input/output error", "Stale", "timed out")):
        raise UnreachableError(f"{path}: cannot be read ({error}). Run the same command again.") from error
    return CorruptRecordError(path, number, f"the record with this number cannot be read ({error})")
