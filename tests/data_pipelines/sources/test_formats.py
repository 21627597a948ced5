"""Every format is read where it lies: the same episodes, frames and actions, by the same interface."""

from __future__ import annotations

import itertools
import json
import pickle
import shutil

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, NoDatasetError, UnreachableError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.inspection.suggest import suggest_entry
from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.names import MANIFEST
from data_pipelines.sampling.splits import HeldOut
from data_pipelines.sources.open import FORMATS, SourceSize, find_format, open_source, read_rate, read_size, source_name
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import write_lerobot, write_robomimic
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.sources.test_lerobot import TOP
from tests.data_pipelines.sources.test_robomimic import VIEW
from tests.data_pipelines.tokenizing import tokenize_dataset


@pytest.mark.parametrize("layout", ["v2.1", "v3.0", "rlds", "robomimic"])
def test_how_many_episodes_there_are_needs_none_of_them(tmp_path, layout, monkeypatch):
    """Plans are made before anything is read; how long they are, not every format says."""
    if layout == "rlds":
        place = write_rlds(tmp_path, make_spec(), [5, 7, 4], shards=2)
    elif layout == "robomimic":
        place = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4), images=False)
        assert read_size(place, "train+valid").episodes == 3 and read_size(place, "valid").episodes == 1
    else:
        place = write_lerobot(tmp_path / "toy-arm", layout, lengths=(5, 7, 4), camera="image")
        info = json.loads((place / "meta" / "info.json").read_text())
        (place / "meta" / "info.json").write_text(json.dumps(info | {"total_frames": 16}))
    monkeypatch.setattr("data_pipelines.sources.rlds.dataset.load_index", lambda *_: pytest.fail("shards were read"))
    expected = SourceSize(3) if layout == "rlds" else SourceSize(3, 16 / 3)
    assert read_size(place, "train") == expected


def test_a_success_that_is_not_said_is_unknown(tmp_path):
    import pyarrow as pa

    def forget(episode, rows):
        rows["next.success"] = pa.array([None] * len(rows["timestamp"]), pa.bool_())

    root = write_lerobot(tmp_path / "toy-arm", "v2.1", change=forget)
    assert open_source(root).episode(0, TOP.image_key, TOP.action_keys).success is None
    texts = {"episode_metadata/success": [b"False"]}
    spec = make_spec("said")
    rlds = write_rlds(tmp_path, spec, [9] * 2, change=lambda _, features: features.update(texts))
    assert open_source(rlds).episode(0, spec.image_key, ()).success is None
    assert [example.success for source in (root, rlds) for example in inspect_dataset(source).examples] == [None] * 4


def as_array_records(directory):
    """The same RLDS directory with ArrayRecord shards, as tfds writes them."""
    from array_record.python.array_record_module import ArrayRecordWriter

    source = RldsDataset(directory)
    out = directory.parent.parent / "records" / "1.0.0"
    shutil.copytree(directory, out, ignore=shutil.ignore_patterns("*tfrecord*"))
    info = json.loads((directory / "dataset_info.json").read_text()) | {"fileFormat": "array_record"}
    (out / "dataset_info.json").write_text(json.dumps(info))
    from data_pipelines.sources.rlds.tfrecord import read_record

    counts, i = [int(n) for n in info["splits"][0]["shardLengths"]], 0
    for k, count in enumerate(counts):
        name = f"{source.name}-train.array_record-{k:05d}-of-{len(counts):05d}"
        writer = ArrayRecordWriter(str(out / name), "group_size:1")
        for _ in range(count):
            writer.write(read_record(*source._locate(i)))
            i += 1
        writer.close()
    return out


@pytest.fixture
def records(tmp_path):
    return as_array_records(write_rlds(tmp_path, make_spec(), [5, 6, 7, 8, 9, 10], shards=2))


def test_array_records_are_read_as_tfrecords_are(tmp_path, records):
    spec = make_spec()
    one, other = RldsDataset(tmp_path / "toy"), open_source(records)
    assert len(other) == 6 and other.runs[1].file == "toy-train.array_record-00001-of-00002"
    for i in (5, 0, 3):
        a, b = (s.episode(i, spec.image_key, spec.action_keys) for s in (one, other))
        assert np.array_equal(a.images, b.images) and np.array_equal(a.actions, b.actions)
        assert np.array_equal(other.frames(i, spec.image_key, lambda n: [n - 1]), [a.images[-1]])
    assert pickle.loads(pickle.dumps(other)).fingerprint() == open_source(records).fingerprint()


def test_damage_in_array_records_is_named(records):
    spec, shard = make_spec(), records / "toy-train.array_record-00001-of-00002"
    data = bytearray(shard.read_bytes())
    open_source(records)
    for at in range(100, len(data) // 2):  # the middle of a record, whichever
        data[at] ^= 0xFF
    shard.write_bytes(data)
    with pytest.raises(DataError, match="00001-of-00002"):
        source = open_source(records)
        for i in range(3, 6):
            source.episode(i, spec.image_key, spec.action_keys)
    shard.unlink()
    with pytest.raises(DataError, match="00001-of-00002: the shard is missing"):
        open_source(records)


def test_a_format_that_is_not_known_is_one_clear_message(records):
    info = json.loads((records / "dataset_info.json").read_text()) | {"fileFormat": "riegeli"}
    (records / "dataset_info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="only tfrecord and array_record can be read"):
        open_source(records)


@pytest.fixture
def places(tmp_path, records):
    """A dataset of each format, with its entry."""
    made = {
        "lerobot": (TOP, write_lerobot(tmp_path / "toy-arm", "v3.0", lengths=(12, 9, 10, 11))),
        "robomimic": (VIEW, write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4, 6))),
        "rlds": (make_spec(), records),
    }
    assert set(made) == set(FORMATS), "add a dataset of yours here"
    assert [find_format(place) for _, place in made.values()] == list(made)
    return list(made.values())


def test_every_format_is_tokenised_directly(tmp_path, places):
    for spec, place in places:
        tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "store", frame_step=1)
        tokenize_dataset(spec, str(place), FakeTokenizer(), tmp_path / "again", frame_step=1, threads=1, batch=3)
    store = TokenStore(tmp_path / "store")
    assert store.hash() == TokenStore(tmp_path / "again").hash()
    for spec, place in places:
        source, manifest = open_source(place), store.manifest(spec.name)
        assert (source_name(place), read_rate(place)) == (source.name, source.hz)
        assert sorted((*manifest.train.episodes, *manifest.val.episodes)) == list(range(len(source)))
        for at, i in enumerate(manifest.train.episodes):
            stored, raw = store.episode(spec.name, "train", at), source.episode(i, spec.image_key, spec.action_keys)
            assert stored.episode == i and len(stored.tokens) == raw.steps
            np.testing.assert_array_equal(stored.actions, raw.actions)
    assert not list(tmp_path.rglob("*.jpg"))


def test_every_format_gives_frames_to_a_tokenizer(places):
    frames = [next(make_frame_loader([place], 8, 8, seed=0, tau=3.0, held_out=HeldOut())) for place in places]
    assert all(f.shape == (8, 8, 8, 3) for f in frames) and frames[0].std() > 1
    mixed = list(itertools.islice(make_frame_loader(places, 8, 8, seed=0, threads=3, tau=3.0, held_out=HeldOut()), 4))
    assert np.array_equal(
        mixed,
        list(itertools.islice(make_frame_loader(places, 8, 8, seed=0, threads=0, tau=3.0, held_out=HeldOut()), 4)),
    )


def test_every_format_is_inspected(places):
    for spec, place in places[:2]:
        sample = inspect_dataset(place)
        facts, shown = sample.facts, sample.examples
        assert (facts.name, facts.hz, facts.episodes, facts.sampled) == (spec.name, spec.hz, 4, 4)
        assert spec.image_key in [c.key for c in facts.cameras] and shown[0].instruction
        assert spec.image_key in shown[0].frames and not facts.damaged
        entry = suggest_entry(facts, facts.hz)
        assert (entry.image_key, entry.action_keys, entry.action_dims) == (
            spec.image_key,
            spec.action_keys,
            spec.action_dims,
        )


def test_what_is_no_dataset_is_told_with_what_to_give_instead(tmp_path):
    """It spoke of RLDS only, also to those who have LeRobot or robomimic data."""
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1", lengths=(5,), camera="image")
    (tmp_path / "demos").mkdir()
    lift = write_robomimic(tmp_path / "demos" / "lift.hdf5")
    toy = write_rlds(tmp_path, make_spec(), [5]).parent
    with pytest.raises(DataError, match=f"^{tmp_path}/toy-arn: no such directory.*LeRobot.* Closest: {arm}$"):
        open_source(tmp_path / "toy-arn")
    with pytest.raises(DataError, match=f"^{tmp_path} is no dataset.* Datasets in it: {toy}, {arm}$"):
        open_source(tmp_path)
    with pytest.raises(DataError, match=f"/demos is no dataset.* Datasets in it: {lift}$"):
        open_source(tmp_path / "demos")
    (arm / "meta" / "info.json").unlink()
    with pytest.raises(NoDatasetError, match=f"/toy-arm is no dataset.* copy {arm}/meta/info.json too$"):
        open_source(arm)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="it is a file, not a directory.*robomimic .hdf5 file.$"):  # not: Closest: file
        open_source(tmp_path / "file")


def test_what_is_no_dataset_is_named(tmp_path):
    with pytest.raises(NoDatasetError, match="no such directory"):
        open_source(tmp_path / "absent")
    (tmp_path / "x.hdf5").write_bytes(b"no file of this kind")
    with pytest.raises(DataError, match="x.hdf5: not a readable HDF5 file"):
        open_source(tmp_path / "x.hdf5")
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1")
    with pytest.raises(ConfigError, match="no split 'test'.* or in the dataset's registry entry\\.$"):
        open_source(arm, "test")
    with pytest.raises(ConfigError, match=r"no split 'train\[:4\]'.* give 'train', .* --set store\.max_train=N\.$"):
        open_source(arm, "train[:4]")


def test_a_token_store_is_no_dataset_and_told_as_such(tmp_path):
    """It was called a directory of foreign files."""
    own = tmp_path / "tokens" / "toy"
    own.mkdir(parents=True)
    (own / MANIFEST).write_text("{}")
    for place in (own, own.parent):
        with pytest.raises(NoDatasetError, match=rf"^{place}: a token store, not recordings\. .* docs/own_data\.md"):
            open_source(place)
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1")
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / MANIFEST).write_text("{}")  # of some other program
    with pytest.raises(NoDatasetError, match=rf" Datasets in it: {arm}$"):
        open_source(tmp_path)


def test_corrupt_records_are_episode_errors():
    assert issubclass(CorruptRecordError, EpisodeError) and not issubclass(UnreachableError, EpisodeError)
