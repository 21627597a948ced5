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
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import train_windows
from tests.data_pipelines.fakes import FakeTokenizer, OneDataset, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec()

FORMAT_2 = """{
 "action_max": [6.0, 10.0, 0.0],
 "action_mean": [3.1739130434782608, 3.58695652173913, 0.0],
 "action_min": [0.0, 0.0, 0.0],
 "action_std": [1.9924242151981915, 2.6091485114173514, 0.0],
 "format": 2,
 "settings": {"frame_step": 2, "keep_frames": "val", "max_val": 200, "min_val": 2, "val_fraction": 0.05},
 "skipped": [],
 "source": "389662f0f93c0e65",
 "source_version": "1.0.0",
 "spec": {"action_dims": [3], "action_keys": ["action"], "camera": "", "hz": 4, "image_key": "observation/image",
  "name": "toy", "note": "", "split": "train", "unverified": "", "version": "", "video_targets": true},
 "tokenizer": {"channels": 0, "factor_vocab": 256, "factors": 2, "grid": 2, "identity": "fake", "image_size": 8,
  "tokens": 4, "vocab_size": 65536},
 "train": {"content": "219c1a943eebee0e60c435f0cf749f4d", "episodes": [0, 1, 2, 3, 4, 6], "parts": [6],
  "steps": [5, 6, 7, 8, 9, 11]},
 "val": {"content": "d818360a9cc70f197ee16b2460da55ae", "episodes": [5, 7], "parts": [2], "steps": [10, 12]}
}
"""
"""As commit 3caafdd wrote it, of eight episodes of `write_rlds`."""


def test_a_store_of_the_format_before_is_read_and_keeps_its_identity(tmp_path):
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy/manifest.json").write_text(FORMAT_2)
    store = TokenStore(tmp_path)
    assert store.manifest("toy").hash() == "e385554ab1617f45" and store.hash() == "c0e0dd2b43268632"
    assert store.manifest("toy").val.episodes == (5, 7) and store.manifest("toy").train.steps == (5, 6, 7, 8, 9, 11)
    assert train_windows(store, "toy", 2, 3, rate=2.0).episodes.tolist() == [0, 2, 5]  # the subset that it had


def test_a_store_of_the_format_before_is_not_made_again(tmp_path):
    rlds = write_rlds(tmp_path / "rlds", SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=2)
    path = tmp_path / "store" / "toy" / "manifest.json"
    path.parent.mkdir(parents=True)
    path.write_text(FORMAT_2)
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    assert manifest.format == 2 and path.read_text() == FORMAT_2
    assert [p.name for p in path.parent.iterdir()] == ["manifest.json"]


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


def test_manifest_of_format_2_with_an_empty_split_has_its_hash(tmp_path):
    values = json.loads(FORMAT_2)
    values["val"] |= {"episodes": [], "steps": [], "parts": []}
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(values))
    manifest = load_manifest(path)
    assert len(manifest.val.episodes) == 0 and manifest.hash()
