"""The index of the shards: made once, kept, checked, and never trusted where it may be stale."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from data_pipelines.errors import DataError, UnreachableError
from data_pipelines.sources.open import SourceSize, read_size
from data_pipelines.sources.rlds import dataset as dataset_module
from data_pipelines.sources.rlds import index as index_module
from data_pipelines.sources.rlds import location
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.frame_spans import FrameSpanCache
from data_pipelines.sources.rlds.index import index_path
from data_pipelines.sources.rlds.tfrecord import scan_shard
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.data_pipelines.shards import index_shard

SPEC = make_spec()
KEYS = (SPEC.image_key, SPEC.action_keys)


@pytest.fixture
def directory(tmp_path, monkeypatch):
    """Eight episodes in four shards that are no longer new."""
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "cache"))
    directory = write_rlds(tmp_path / "rlds", SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=4)
    for shard in shards(directory):
        os.utime(shard, (time.time() - 3600,) * 2)
    return directory


@pytest.fixture
def scanned(monkeypatch):
    """Names of the shards that are scanned."""
    names = []

    def scan(path):
        names.append(path.name[-14:])
        return scan_shard(path)

    monkeypatch.setattr(dataset_module, "scan_shard", scan)
    return names


def shards(directory):
    return sorted(directory.glob("*.tfrecord*"))


def test_a_second_start_opens_no_shard(directory, scanned, monkeypatch):
    first = RldsDataset(directory)
    assert len(scanned) == 4
    opened, real = [], os.open

    def watch(path, *args, **options):
        opened.append(str(path))
        return real(path, *args, **options)

    monkeypatch.setattr(location.os, "open", watch)
    second = RldsDataset(directory)
    assert len(scanned) == 4 and not [p for p in opened if "tfrecord" in p]
    assert np.array_equal(second.sizes(), first.sizes()) and second.fingerprint() == first.fingerprint()
    assert second.episode(6, *KEYS).steps == 11


def test_another_process_reuses_it(directory, scanned):
    RldsDataset(directory)
    code = (
        "import sys, data_pipelines.sources.rlds.dataset as d\n"
        "d.scan_shard = None\n"
        "print(len(d.RldsDataset(sys.argv[1])))"
    )
    command = [sys.executable, "-c", code, str(directory)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "8\n"


def test_it_holds_columns_that_are_mapped(directory):
    RldsDataset(directory)
    index = RldsDataset(directory)._index
    for name, kind in index_module.COLUMNS.items():
        column = getattr(index, name)
        assert column.dtype == kind and isinstance(column.base, np.memmap) and not column.flags.writeable


def test_only_a_shard_that_changed_is_scanned_again(directory, scanned):
    RldsDataset(directory)
    scanned.clear()
    os.utime(shards(directory)[2], (time.time() - 1800,) * 2)
    assert len(RldsDataset(directory)) == 8
    assert scanned == ["00002-of-00004"]


def test_a_shard_of_this_moment_is_not_trusted(directory, scanned):
    """Its next version could bear the same time."""
    os.utime(shards(directory)[1])
    RldsDataset(directory)
    scanned.clear()
    RldsDataset(directory)
    assert scanned == ["00001-of-00004"]


def test_a_shard_of_next_month_is_not_scanned_at_every_start(directory, scanned):
    """As copied from a machine whose clock was ahead."""
    os.utime(shards(directory)[1], (time.time() + 30 * 86400,) * 2)
    for _ in range(2):
        RldsDataset(directory)
    assert len(scanned) == 4


def test_a_damaged_index_is_made_again(directory, scanned):
    expected = RldsDataset(directory).fingerprint()
    path = index_path(directory, "train")
    data = bytearray(path.read_bytes())
    for at in (3, 60, len(data) - 1, len(data) // 2):
        spoilt = bytearray(data)
        spoilt[at] ^= 1
        path.write_bytes(spoilt)
        assert RldsDataset(directory).fingerprint() == expected
    path.write_bytes(data[:-9])
    assert RldsDataset(directory).fingerprint() == expected
    assert path.read_bytes() == data


def test_damage_is_known_without_a_second_scan(directory, scanned):
    shard = shards(directory)[1]
    shard.write_bytes(shard.read_bytes()[:-10])
    os.utime(shard, (time.time() - 3600,) * 2)
    for _ in range(2):
        with pytest.raises(DataError, match="00001-of-00004: corrupt record at byte .*truncated"):
            RldsDataset(directory)
        rest = RldsDataset(directory, corrupt="skip")
        assert len(rest) == 7 and "truncated" in next(iter(rest.skipped))
    assert len(scanned) == 4


def test_what_was_scanned_before_the_disk_failed_is_kept(directory, scanned, monkeypatch):
    monkeypatch.setattr(index_module, "SCANS", 1)
    real = dataset_module.scan_shard

    def scan(path):
        if path.name.endswith("00002-of-00004"):
            raise UnreachableError("gone")
        return real(path)

    with monkeypatch.context() as broken:
        broken.setattr(dataset_module, "scan_shard", scan)
        with pytest.raises(UnreachableError, match="gone"):
            RldsDataset(directory, corrupt="skip")
    scanned.clear()
    assert len(RldsDataset(directory)) == 8
    assert scanned == ["00002-of-00004", "00003-of-00004"]


def test_shards_that_exchanged_their_names_are_found(directory):
    a, b = shards(directory)[1:3]
    RldsDataset(directory)
    aside = a.with_name("aside")
    a.rename(aside), b.rename(a), aside.rename(b)
    for corrupt in ("raise", "skip"):
        with pytest.raises(DataError, match=r"00001-of-00004 and .*00002-of-00004: .* swapped names"):
            RldsDataset(directory, corrupt=corrupt)
    index_path(directory, "train").unlink()
    assert RldsDataset(directory).episode(2, *KEYS).steps == 9


def test_a_cache_that_cannot_be_written_is_said(directory, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="HMA_CACHE_DIR"):
        assert len(RldsDataset(directory)) == 8


def test_processes_that_start_together_scan_once(directory, tmp_path):
    code = (
        "import sys, data_pipelines.sources.rlds.dataset as d\n"
        "real = d.scan_shard\n"
        "def scan(path):\n"
        "    open(sys.argv[2], 'a').write(path.name + '\\n')\n"
        "    return real(path)\n"
        "d.scan_shard = scan\n"
        "d.RldsDataset(sys.argv[1])\n"
    )
    command = [sys.executable, "-c", code, str(directory), str(tmp_path / "log")]
    running = [subprocess.Popen(command) for _ in range(3)]
    assert [p.wait() for p in running] == [0, 0, 0]
    assert len((tmp_path / "log").read_text().split()) == 4


def test_steps_are_known_once_an_episode_was_read(directory):
    first = RldsDataset(directory)
    assert set(first.steps().tolist()) == {-1}
    first.episode(3, *KEYS)
    first.save_steps()
    other = RldsDataset(directory)
    other.frames(5, SPEC.image_key, lambda n: [0])
    other.save_steps()
    assert RldsDataset(directory).steps().tolist() == [-1, -1, -1, 8, -1, 10, -1, -1]
    assert read_size(directory, "train") == SourceSize(8, 9.0) and read_size(directory, "train+val") is None
    shards(directory)[0].write_bytes(b"")
    assert set(RldsDataset(directory, corrupt="skip").steps().tolist()) == {-1}


def test_places_of_frames_give_way_when_they_are_too_many():
    places = FrameSpanCache(limit=8 * 100)
    for i in range(50):
        places.put((i, "camera"), [(n, n + 1) for n in range(10)])
        assert places.get((0, "camera")) is not None  # asked for again and again
        assert len(places) <= 10
    assert places.get((49, "camera")).tolist()[3] == [3, 4] and places.get((5, "camera")) is None
    places.put((7, "large"), [(2**40, 2**40 + 1)])
    assert places.get((7, "large")).tolist() == [[2**40, 2**40 + 1]]


def test_small_records_of_a_remote_shard_share_requests(tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    UPath = pytest.importorskip("upath").UPath
    from data_pipelines.sources.rlds.tfrecord import write_shard

    write_shard(tmp_path / "shard", [bytes(20_000)] * 100)
    fs = fsspec.filesystem("memory")
    fs.put(str(tmp_path / "shard"), "/requests/shard")
    asked, read = [], fs.cat_file
    monkeypatch.setattr(
        fs, "cat_file", lambda path, start, end: (asked.append(end - start), read(path, start=start, end=end))[1]
    )
    assert len(index_shard(UPath("memory://requests/shard"))) == 100
    assert len(asked) <= 3
    write_shard(tmp_path / "large", [bytes(2**20)] * 5)
    fs.put(str(tmp_path / "large"), "/requests/large")
    asked.clear()
    assert len(index_shard(UPath("memory://requests/large"))) == 5
    assert sum(asked) < 2**17  # large records are not read through
