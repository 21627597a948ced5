from __future__ import annotations

import gzip
import pickle
import zlib

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError
from data_pipelines.sources.rlds.tfrecord import HEADER, read_record, scan_shard, write_shard
from tests.data_pipelines.fakes import REAL_DATA
from tests.data_pipelines.shards import index_shard
from tests.full_disk import full_disk

RECORDS = [b"first", b"", b"a longer third record" * 20]


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "toy.tfrecord"
    assert write_shard(path, RECORDS) == 3
    return path


def flip(path, byte: int):
    data = bytearray(path.read_bytes())
    data[byte] ^= 0x10
    path.write_bytes(data)


def test_any_record_is_read_in_any_order(shard):
    index = index_shard(shard)
    for i in (2, 0, 1):
        assert read_record(shard, index.offsets[i], index.lengths[i]) == RECORDS[i]


def test_framing_written_by_tfds_is_understood():
    shard = next(REAL_DATA.glob("*/*.tfrecord*"))
    index = index_shard(shard)
    assert len(index) == 3
    assert len(read_record(shard, int(index.offsets[2]), int(index.lengths[2]))) == index.lengths[2]
    assert sum(index.lengths) + 16 * 3 == shard.stat().st_size


def test_writing_gives_the_bytes_that_were_read(tmp_path):
    shard = next(REAL_DATA.glob("*/*.tfrecord*"))
    index = index_shard(shard)
    places = zip(index.offsets.tolist(), index.lengths.tolist(), strict=True)
    copy = tmp_path / "copy"
    write_shard(copy, (read_record(shard, offset, length) for offset, length in places))
    assert copy.read_bytes() == shard.read_bytes()


@pytest.mark.parametrize("kept", [5, HEADER + 3, 16 + 5 + 16 + 20])
def test_truncated_shard_names_file_and_offset(shard, kept):
    shard.write_bytes(shard.read_bytes()[:kept])
    with pytest.raises(CorruptRecordError) as caught:
        index_shard(shard)
    assert caught.value.path == shard
    assert caught.value.offset == (0 if kept < 21 else 37)
    assert str(shard) in str(caught.value) and f"byte {caught.value.offset}" in str(caught.value)


def test_flipped_bit_in_a_length_is_found_by_the_index(shard):
    flip(shard, 21)  # the second record's length
    with pytest.raises(CorruptRecordError, match="byte 21: the checksum of the record's length"):
        index_shard(shard)
    index, damage = scan_shard(shard)
    assert len(index) == 1 and damage.offset == 21


@pytest.mark.parametrize("compress", [gzip.compress, zlib.compress])
def test_a_compressed_shard_is_no_damage(shard, compress):
    """Downloading it again, as was advised, would give the same bytes."""
    shard.write_bytes(compress(shard.read_bytes()))
    with pytest.raises(
        DataError, match="toy.tfrecord: it is compressed with GZIP or ZLIB.*without compression"
    ) as raised:
        scan_shard(shard)
    assert not isinstance(raised.value, EpisodeError)


@pytest.mark.parametrize("byte", [37 + HEADER + 9, 37 + HEADER + len(RECORDS[2]) + 1])  # data, its checksum
def test_flipped_bit_in_data_is_found_by_the_read(shard, byte):
    flip(shard, byte)
    index = index_shard(shard)  # reads no data
    assert read_record(shard, index.offsets[0], index.lengths[0]) == RECORDS[0]
    with pytest.raises(CorruptRecordError, match="byte 37: the checksum of the record's data"):
        read_record(shard, int(index.offsets[2]), int(index.lengths[2]))


def test_stale_index_of_a_shortened_file_is_an_error(shard):
    index = index_shard(shard)
    shard.write_bytes(shard.read_bytes()[:40])
    with pytest.raises(CorruptRecordError, match="shorter since it was indexed"):
        read_record(shard, int(index.offsets[2]), int(index.lengths[2]))


def test_missing_shard_is_one_clear_message(tmp_path):
    with pytest.raises(DataError, match="the shard is missing"):
        index_shard(tmp_path / "absent")


def test_empty_file_has_no_records(tmp_path):
    (tmp_path / "empty").touch()
    assert len(index_shard(tmp_path / "empty")) == 0


def test_failed_write_leaves_no_file(tmp_path):
    def records():
        yield b"one"
        raise RuntimeError("the simulation died")

    with pytest.raises(RuntimeError):
        write_shard(tmp_path / "out", records())
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_of_the_shard_and_leaves_nothing(tmp_path):
    with full_disk(100), pytest.raises(OSError, match="shard-0"):
        write_shard(tmp_path / "shard-0", [b"one" * 99])
    assert list(tmp_path.iterdir()) == []


def test_error_survives_the_way_between_processes():
    error = pickle.loads(pickle.dumps(CorruptRecordError("a/b", 7, "why")))
    assert (str(error.path), error.offset, error.reason) == ("a/b", 7, "why")


def test_index_holds_plain_integers(shard):
    index = index_shard(shard)
    assert index.offsets.dtype == index.lengths.dtype == np.int64
    assert index.offsets.tolist() == [0, 21, 37]
