"""The manifest's files: columns that are read when they are used, and stores of the format before."""

from __future__ import annotations

import json
import pickle
import time
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.columns import Column, Columns, write_columns
from data_pipelines.errors import DataError
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.tokens.manifest import SplitFacts
from data_pipelines.tokens.manifest_file import load_manifest
from tests.data_pipelines.fakes import OneDataset, make_spec

SPEC = make_spec()


@pytest.fixture
def large():
    """The manifest of 300,000 episodes in 1,000 shards."""
    episodes = 300_000
    steps = np.random.default_rng(0).integers(20, 400, episodes)
    base = OneDataset([5, 6])._manifest
    cut = episodes * 19 // 20
    splits = {
        "train": SplitFacts(np.arange(cut), steps[:cut], "a", (cut,)),
        "val": SplitFacts(np.arange(cut, episodes), steps[cut:], "b", (episodes - cut,)),
    }
    runs = tuple(EpisodeRun(f"toy-train.tfrecord-{k:05d}-of-01000", 0, 300) for k in range(1000))
    return replace(base, runs=runs, **splits)


def save(manifest, directory):
    aside = directory / "aside"
    aside.mkdir(parents=True)
    manifest.save(directory, aside)
    aside.rmdir()
    return directory / "manifest.json"


def test_a_large_manifest_is_small_and_read_when_it_is_used(tmp_path, large):
    path = save(large, tmp_path)
    columns = path.with_name("episodes.columns")
    assert path.stat().st_size < 200_000 and columns.stat().st_size < 8 * 300_000 + 1000
    began = time.perf_counter()
    read = load_manifest(path)
    assert read.hash() == large.hash()
    assert time.perf_counter() - began < 1
    assert read.train.steps._array is None and not read.train.steps._lazy[0]._mapped  # nothing was read yet
    assert len(read.train.episodes) == 285_000
    assert read == large
    assert isinstance(np.asarray(read.train.steps).base, np.memmap)
    assert read.train.native_frames == int(np.asarray(large.train.steps).sum())
    assert pickle.loads(pickle.dumps(read)) == large


@pytest.mark.parametrize("at", ["first", "middle", "last", "cut"])
def test_damaged_columns_are_named(tmp_path, large, at):
    path = save(large, tmp_path)
    columns = path.with_name("episodes.columns")
    data = bytearray(columns.read_bytes())
    if at == "cut":
        del data[-100:]
    else:
        data[{"first": 0, "middle": len(data) // 2, "last": -1}[at]] ^= 1
    columns.write_bytes(data)
    with pytest.raises(DataError, match="episodes.columns: damaged"):
        manifest = load_manifest(path)
        for split in ("train", "val"):
            np.asarray(manifest.split(split).steps), np.asarray(manifest.split(split).episodes)


def test_columns_of_another_manifest_are_refused(tmp_path, large):
    path = save(large, tmp_path / "a")
    other = save(replace(large, train=replace(large.train, steps=np.asarray(large.train.steps) + 1)), tmp_path / "b")
    path.with_name("episodes.columns").write_bytes(other.with_name("episodes.columns").read_bytes())
    with pytest.raises(DataError, match="episodes.columns does not belong to it"):
        load_manifest(path)
    path.with_name("episodes.columns").unlink()
    with pytest.raises(DataError, match="cannot be read"):
        load_manifest(path)


def test_hash_follows_every_entry_and_every_name(large):
    steps = np.array(large.train.steps)
    steps[7] += 1
    assert replace(large, train=replace(large.train, steps=steps)).hash() != large.hash()
    runs = (replace(large.runs[0], file="other"), *large.runs[1:])
    assert replace(large, runs=runs).hash() != large.hash()


# --- columns ---------------------------------------------------------------------------------------


def test_a_column_is_a_tuple_of_integers_to_its_users():
    column = Column([3, 1, 2])
    assert (*column,) == (3, 1, 2) and column == (3, 1, 2) and column[-1] == 2 and 1 in column
    assert column[1:] == (1, 2) and sorted(column) == [1, 2, 3] and column != Column([3, 1])
    with pytest.raises(ValueError, match="is not a column"):
        Column([2**31])


@pytest.mark.parametrize("byte", [0, 9, 20, 50, -1])
def test_any_changed_byte_is_found(tmp_path, byte):
    path = tmp_path / "file"
    write_columns(path, {"a": 1}, {"x": np.arange(5), "none": np.zeros(0, np.uint32)})
    columns = Columns(path)
    assert columns.facts == {"a": 1} and columns["x"].tolist() == [0, 1, 2, 3, 4] and len(columns["none"]) == 0
    data = bytearray(path.read_bytes())
    data[byte] ^= 4
    path.write_bytes(data)
    with pytest.raises(DataError, match=f"{path}: damaged"):
        Columns(path)["x"]


def test_columns_appear_whole_or_not_at_all(tmp_path, monkeypatch):
    write_columns(tmp_path / "file", {}, {"x": np.arange(3)})
    monkeypatch.setattr("os.fsync", lambda fd: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        write_columns(tmp_path / "file", {}, {"x": np.arange(9)})
    assert [p.name for p in tmp_path.iterdir()] == ["file"] and len(Columns(tmp_path / "file")["x"]) == 3


def test_a_column_that_claims_more_than_its_file_is_refused(tmp_path):
    path = tmp_path / "file"
    write_columns(path, {}, {"x": np.arange(3)})
    columns = Columns(path)
    columns._table["x"] = ("<i8", 2**50, 0, "")
    with pytest.raises(DataError, match="reaches beyond the end of the file"):
        columns["x"]
    assert json.dumps(columns.facts) == "{}"
