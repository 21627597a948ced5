"""Datasets in remote stores, by fsspec's own in memory."""

from __future__ import annotations

import errno
import sys
import tempfile

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError, DataError, UnreachableError
from data_pipelines.sources.rlds import location, tfrecord
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.location import absolute, is_remote, locate
from data_pipelines.sources.rlds.schema import dataset_name
from data_pipelines.sources.rlds.tfrecord import open_record, scan_shard
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.shards import index_shard
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.full_disk import full_disk

UPath = pytest.importorskip("upath").UPath

SPEC = make_spec(hz=4)
KEYS = (SPEC.image_key, SPEC.action_keys)


@pytest.fixture
def local(tmp_path):
    return write_rlds(tmp_path, SPEC, [5, 6, 7, 8, 9, 10], shards=2)


@pytest.fixture
def remote(local):
    """A copy of `local` in memory; its version directory."""
    root = UPath("memory://bucket/data") / SPEC.name
    for path in local.iterdir():
        copy = root / "1.0.0" / path.name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    yield root / "1.0.0"
    root.fs.rm("/bucket", recursive=True)


def test_remote_dataset_reads_as_the_local_one(local, remote):
    here, there = RldsDataset(local), RldsDataset("memory://bucket/data/toy")  # the newest version of
    assert str(there.directory) == "memory://bucket/data/toy/1.0.0" and dataset_name(remote) == "toy"
    assert there.fingerprint() == here.fingerprint() and len(there) == 6
    for i in (5, 0):
        a, b = here.episode(i, *KEYS), there.episode(i, *KEYS)
        assert np.array_equal(a.images, b.images) and np.array_equal(a.actions, b.actions)


def test_remote_dataset_makes_the_same_store(local, remote, tmp_path):
    for name, directory in (("a", local), ("b", str(remote))):
        tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / name)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 7
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)


def test_index_of_a_remote_shard_reads_a_block_at_a_time(remote, monkeypatch):
    asked = watch(remote.fs, monkeypatch)
    shard = sorted(remote.glob("*.tfrecord*"))[0]
    index = index_shard(shard)
    assert len(index) == 3 and len(asked) == 1  # small records share a request
    monkeypatch.setattr(tfrecord, "SCAN_BLOCK", 64)
    monkeypatch.setattr(tfrecord, "REMOTE_SMALL", 0)
    asked.clear()
    assert np.array_equal(index_shard(shard).offsets, index.offsets)
    assert 3 <= len(asked) <= 5 and max(asked) <= 64


def test_large_remote_record_is_fetched_once_and_in_pieces(remote, monkeypatch):
    monkeypatch.setattr(tfrecord, "MAX_WHOLE_READ", 100)
    monkeypatch.setattr(tfrecord, "CHUNK", 256)
    dataset = RldsDataset(remote)
    expected = dataset.record(4)
    asked = watch(remote.fs, monkeypatch)
    assert dataset.episode(4, *KEYS).steps == 9
    assert sum(asked) == dataset.sizes()[4] + tfrecord.FOOTER and max(asked) == 256
    assert dataset.record(4).keys() == expected.keys()


@pytest.mark.parametrize("place", ["full", "missing"])
def test_no_room_for_the_copy_of_a_large_record_is_no_fault_of_the_token_store(remote, tmp_path, monkeypatch, place):
    monkeypatch.setattr(tfrecord, "MAX_WHOLE_READ", 100)
    temporary = tmp_path / "temporary"
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    if place == "full":
        temporary.mkdir()
    dataset = RldsDataset(remote, corrupt="skip")
    with full_disk(100), pytest.raises(UnreachableError, match=rf"{temporary}: .*00000-of-00002.*TMPDIR") as caught:
        dataset.episode(0, *KEYS)
    assert not dataset.skipped and ("File too large" if place == "full" else "No such file") in str(caught.value)
    temporary.mkdir(exist_ok=True)
    with pytest.raises(OSError, match="of the caller"), tfrecord.open_record(*dataset._locate(0)):
        raise OSError("of the caller")


def watch(fs, monkeypatch) -> list[int]:
    """The lengths of all reads from `fs`."""
    asked, read = [], fs.cat_file

    def cat_file(path, start=None, end=None, **options):
        asked.append(end - start)
        return read(path, start, end, **options)

    monkeypatch.setattr(fs, "cat_file", cat_file)
    return asked


def test_damage_of_a_remote_record_is_found(remote):
    shard = sorted(remote.glob("*.tfrecord*"))[1]
    data = bytearray(shard.read_bytes())
    data[40] ^= 1
    shard.write_bytes(bytes(data))
    dataset = RldsDataset(remote)
    with pytest.raises(CorruptRecordError, match=r"memory://bucket/.*00001-of-00002: corrupt .* byte 0"):
        dataset.episode(3, *KEYS)
    shard.write_bytes(bytes(data[:-3]))
    assert scan_shard(shard)[1].offset > 0
    shard.unlink()
    with pytest.raises(DataError, match="memory://.*the shard is missing"):
        RldsDataset(remote)


def test_store_that_does_not_answer_costs_no_episode(remote, tmp_path, monkeypatch):
    def broken(*args, **options):
        raise ConnectionError("no route")

    monkeypatch.setattr(location, "RETRY_WAITS", (0.0, 0.0))
    dataset = RldsDataset(remote, corrupt="skip")
    monkeypatch.setattr(remote.fs, "cat_file", broken)
    with pytest.raises(UnreachableError, match="cannot be read .*no route.*run the same command again"):
        dataset.episode(0, *KEYS)
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "empty"))
    with pytest.raises(UnreachableError):
        RldsDataset(remote, corrupt="skip")


def test_a_store_that_cannot_be_asked_is_not_said_to_have_no_dataset(remote, monkeypatch):
    """Of a failing store fsspec says that there is no such file or directory."""
    monkeypatch.setattr(location, "RETRY_WAITS", (0.0, 0.0))
    working, failures = remote.fs.info, [1]

    def info(*args, **options):
        if failures[0]:
            failures[0] -= 1
            raise OSError(errno.ECONNRESET, "reset by peer")
        return working(*args, **options)

    monkeypatch.setattr(remote.fs, "info", info)
    assert len(RldsDataset("memory://bucket/data/toy")) == 6
    failures[0] = 10**6
    with pytest.raises(UnreachableError, match="memory://bucket/data/toy: cannot be read .*reset by peer"):
        RldsDataset("memory://bucket/data/toy")


@pytest.mark.parametrize("whole", [0, 2**20])
def test_local_record_is_the_same_at_once_and_in_pieces(local, monkeypatch, whole):
    monkeypatch.setattr(tfrecord, "MAX_WHOLE_READ", whole)
    index = index_shard(sorted(local.glob("*.tfrecord*"))[0])
    place = (index.path, int(index.offsets[1]), int(index.lengths[1]))
    with open_record(*place) as payload:
        assert len(payload) == index.lengths[1]
        assert payload[7:20] == tfrecord.read_record(*place)[7:20]
        with pytest.raises(IndexError):
            payload[len(payload)]


def test_paths_stay_paths_and_urls_stay_urls(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert absolute("a/b") == str(tmp_path / "a/b") and not is_remote("a/b")
    assert absolute("gs://bucket/a") == "gs://bucket/a" and is_remote("gs://bucket/a")
    assert not is_remote(tmp_path / "odd://name")


def test_unknown_protocol_is_one_clear_message(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(
        ConfigError, match="hf://x: .*huggingface_hub.*other protocols also the package that fsspec asks"
    ):
        locate("hf://x")
    with pytest.raises(ConfigError, match="nowhere://x: fsspec does not know this kind of location"):
        locate("nowhere://x")
