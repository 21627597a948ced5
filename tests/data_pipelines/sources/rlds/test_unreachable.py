"""A disk that fails is no damage of data: reads are tried again, then the job stops."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, UnreachableError
from data_pipelines.sources.rlds import location
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.location import OpenFiles, retry
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.shards import index_shard
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec()
KEYS = (SPEC.image_key, SPEC.action_keys)


@pytest.fixture
def directory(tmp_path):
    return write_rlds(tmp_path / "rlds", SPEC, [5, 6, 7, 8, 9, 10], shards=2)


@pytest.fixture
def waits(monkeypatch):
    """Waiting takes no time; gives the seconds that were waited."""
    waited = []
    monkeypatch.setattr(location.time, "sleep", waited.append)
    return waited


def fail(monkeypatch, name, number, times):
    """`os.<name>` raises this error `times` times; afterwards it works."""
    real, left = getattr(os, name), [times]

    def failing(*args, **options):
        if left[0]:
            left[0] -= 1
            raise OSError(number, os.strerror(number))
        return real(*args, **options)

    monkeypatch.setattr(location.os, name, failing)


@pytest.mark.parametrize("number", [errno.ESTALE, errno.EIO, errno.ETIMEDOUT])
@pytest.mark.parametrize("corrupt", ["raise", "skip"])
def test_a_read_that_fails_for_ever_stops_and_costs_no_episode(directory, monkeypatch, waits, number, corrupt):
    dataset = RldsDataset(directory, corrupt=corrupt)
    fail(monkeypatch, "pread", number, 10**6)
    with pytest.raises(
        UnreachableError, match=rf"{directory}.*00000-of-00002: cannot be read .*{os.strerror(number)}"
    ) as caught:
        dataset.episode(0, *KEYS)
    assert not isinstance(caught.value, EpisodeError) and not dataset.skipped
    assert len(waits) == len(location.RETRY_WAITS) and sum(waits) < 15


def test_a_job_stops_under_skip_too_and_publishes_nothing(directory, tmp_path, monkeypatch, waits):
    index_shard(sorted(directory.glob("*.tfrecord*"))[0])
    RldsDataset(directory)
    fail(monkeypatch, "pread", errno.ESTALE, 10**6)
    with pytest.raises(UnreachableError):
        tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "store", corrupt="skip", max_skipped=99)
    assert not (tmp_path / "store" / "toy").exists()


def test_a_disk_that_comes_back_is_read_on(directory, monkeypatch, waits):
    expected = RldsDataset(directory).episode(3, *KEYS)
    dataset = RldsDataset(directory)
    fail(monkeypatch, "pread", errno.ESTALE, 3)
    assert np.array_equal(dataset.episode(3, *KEYS).actions, expected.actions)
    assert waits  # and it was waited for


def test_scanning_is_no_different(directory, tmp_path, monkeypatch, waits):
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "empty"))
    fail(monkeypatch, "pread", errno.EIO, 10**6)
    with pytest.raises(UnreachableError):
        RldsDataset(directory, corrupt="skip", max_skipped=99)
    monkeypatch.undo()
    assert len(RldsDataset(directory)) == 6


def test_a_file_that_cannot_be_opened_is_not_corrupt(directory, monkeypatch, waits):
    dataset = RldsDataset(directory, corrupt="skip")
    fail(monkeypatch, "open", errno.EMFILE, 10**6)
    with pytest.raises(UnreachableError, match="Too many open files"):
        dataset.episode(0, *KEYS)


def test_a_file_that_stays_open_is_opened_again_when_it_went_stale(tmp_path, monkeypatch, waits):
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    files = OpenFiles()
    held = files.get(path)
    fail(monkeypatch, "pread", errno.ESTALE, 1)
    assert held.read(2, 3) == b"234" and held.read(0, 1) == b"0"


def test_a_file_that_was_replaced_meanwhile_is_not_read_as_the_old_one(tmp_path, monkeypatch, waits):
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    held = OpenFiles().get(path)
    path.write_bytes(b"other contents")
    fail(monkeypatch, "pread", errno.ESTALE, 1)
    with pytest.raises(DataError, match="was replaced while it was being read"):
        held.read(0, 4)


def test_what_no_waiting_mends_is_not_waited_for(tmp_path, waits):
    def denied():
        raise PermissionError(errno.EACCES, "Permission denied")

    with pytest.raises(UnreachableError, match="Permission denied"):
        retry(tmp_path, denied)
    assert not waits


def test_bytes_that_were_read_and_are_wrong_are_corrupt(directory, waits):
    shard = sorted(directory.glob("*.tfrecord*"))[0]
    data = bytearray(shard.read_bytes())
    data[100] ^= 1
    shard.write_bytes(data)
    with pytest.raises(CorruptRecordError):
        RldsDataset(directory).episode(0, *KEYS)
    assert not waits
