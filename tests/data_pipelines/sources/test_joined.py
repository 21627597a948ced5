"""Several datasets that are read as one: the same episodes as in each, under names that do not depend on the others."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.sampling.splits import HeldOut, held_out, held_out_episodes
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.joined import Parts
from data_pipelines.sources.open import open_source
from data_pipelines.tokens.dataset_writer import differences
from data_pipelines.tokens.store import TokenStore
from data_pipelines.tokens.tokenize_job import plan_dataset
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import write_lerobot, write_robomimic
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

ARM = replace(make_spec("arm", (3,), hz=10), joins=("folder", "robomimic_lift", "shards"))


def as_arm(file):
    """A robomimic file with the camera, the action and the rate of ARM."""
    env = json.loads(file["data"].attrs["env_args"])
    env["env_kwargs"]["control_freq"] = 10
    file["data"].attrs["env_args"] = json.dumps(env)
    for demo in file["data"].values():
        demo.move("obs/agentview_image", "obs/image_image")
        actions = demo["actions"][:, :3]
        del demo["actions"]
        demo["actions"] = actions


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A directory of each format."""
    monkeypatch.setattr("tests.data_pipelines.convert.sources.CAMERA", "observation.images.image")
    return (
        write_lerobot(tmp_path / "folder", "v2.1", (12, 9, 10, 11)),
        write_robomimic(tmp_path / "image.hdf5", (5, 7, 4, 6), change=as_arm),
        write_rlds(tmp_path, replace(ARM, name="shards"), [8, 9, 7, 6, 8], shards=2),
    )


def join(places, **how):
    return open_source(Parts("arm", tuple(places)), **how)


def split_by_name(manifest) -> dict[str, set[str]]:
    """The names of the episodes of each split."""
    names = [f"{run.file} {run.first + k}" for run in manifest.runs for k in range(run.count)]
    return {split: {names[i] for i in manifest.split(split).episodes} for split in ("train", "val")}


def test_parts_of_any_format_are_read_as_one_dataset(places):
    parts = [open_source(place) for place in places]
    for joined in (join(places), pickle.loads(pickle.dumps(join(places)))):
        joined.check_keys(ARM.image_key, ARM.action_keys, ARM.action_dims)
        assert (joined.name, joined.hz, len(joined), joined.files) == ("arm", 10, 13, sum(p.files for p in parts))
        assert joined.steps()[:8].tolist() == [12, 9, 10, 11, 5, 7, 4, 6] and (joined.sizes() > 0).all()
        assert joined.numbers.tolist() == list(range(13)) and len(set(joined.ids.tolist())) == 13
        own = [(part, k) for part in parts for k in range(len(part))]
        for i, (part, k) in enumerate(own):
            one, other = (s.episode(n, ARM.image_key, ARM.action_keys) for s, n in ((joined, i), (part, k)))
            assert one.success is other.success
            assert np.array_equal(one.images, other.images) and np.array_equal(one.actions, other.actions)
            frames = (s.frames(n, ARM.image_key, lambda n: [n - 1, 0]) for s, n in ((joined, i), (part, k)))
            assert np.array_equal(*frames)
            said = [s.record(n, ["steps/action"])["steps/action"] for s, n in ((joined, i), (part, k))]
            assert np.array_equal(*said)
        with pytest.raises(IndexError):
            joined.episode(13, ARM.image_key, ())
    assert {run.file.split("/")[0] for run in joined.runs} == set(ARM.joins)


def test_what_is_joined_is_known_by_its_parts_and_not_by_where_they_lie(places, tmp_path):
    whole = join(places).fingerprint()
    moved = [shutil.move(places[0], tmp_path / "elsewhere" / "folder"), *places[1:]]
    assert join(moved).fingerprint() == whole
    assert len({whole, *(join(some).fingerprint() for some in (moved[:2], moved[::-1], moved[:1]))}) == 4


def test_the_same_episodes_are_held_out_of_a_part_whatever_is_joined(tmp_path):
    """Those that are held out of it as a dataset by itself: by a hash of all, others would be."""
    specs = [make_spec(name) for name in ("one", "two", "three")]
    rlds = {spec.name: write_rlds(tmp_path, spec, [8] * n) for spec, n in zip(specs, (12, 20, 1), strict=True)}
    chosen = {}
    for names in (("one",), ("one", "two"), ("three", "two", "one")):
        spec = replace(make_spec("all"), joins=names)
        place = Parts("all", tuple(rlds[name] for name in names))
        manifest = tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "-".join(names))
        chosen[names] = split_by_name(manifest)
        for name in names:
            alone = open_source(rlds[name])
            own = {f"{name}/{alone.runs[0].file} {i}" for i in np.flatnonzero(held_out(name, alone.ids, HeldOut()))}
            assert {episode for episode in chosen[names]["val"] if episode.startswith(f"{name}/")} == own
    assert [len(split["val"]) for split in chosen.values()] == [2, 4, 4]  # of the one of three none can be


def test_the_validation_splits_of_all_parts_are_held_out():
    spec = replace(make_spec("all"), split="train+val", val_split="val", joins=("one", "two"))
    runs = [
        EpisodeRun(f"{part}/{split}", 0, n, split) for part in spec.joins for split, n in (("train", 3), ("val", 1))
    ]
    assert held_out_episodes(spec, runs, HeldOut()).tolist() == [False, False, False, True] * 2


def test_a_joined_dataset_is_tokenised_in_parts_with_statistics_of_all(places, tmp_path):
    place = Parts("arm", places)
    sizes = join(places).sizes()
    for store, size in (("whole", 2**30), ("cut", int(sizes.max()))):
        tokenize_dataset(ARM, place, FakeTokenizer(), tmp_path / store, frame_step=1, part_size=size)
    store = TokenStore(tmp_path / "cut")
    manifest, source = store.manifest("arm"), join(places)
    assert store.names == ("arm",) and len(manifest.train.parts) > 3
    whole = TokenStore(tmp_path / "whole").manifest("arm")
    assert manifest.train.episodes == whole.train.episodes and manifest.val.episodes == whole.val.episodes
    actions = [source.episode(i, ARM.image_key, ARM.action_keys).actions for i in manifest.train.episodes]
    np.testing.assert_allclose(manifest.action_mean, np.concatenate(actions).mean(0), rtol=1e-5)
    np.testing.assert_allclose(whole.action_mean, manifest.action_mean, rtol=1e-6)
    assert manifest.spec.joins == ARM.joins and manifest.episodes_of_parts == [4, 4, 5]
    batch = next(make_frame_loader([(ARM, place)], 8, 8, seed=0, tau=3.0, held_out=HeldOut()))
    assert batch.shape == (8, 8, 8, 3)


def test_another_limit_of_held_out_episodes_is_judged_by_the_parts(tmp_path):
    """Of forty episodes it would change nothing; of the four of each part it does."""
    specs = [make_spec(f"part_{k}") for k in range(10)]
    place = Parts("all", tuple(write_rlds(tmp_path, spec, [8] * 4) for spec in specs))
    spec = replace(make_spec("all"), joins=tuple(s.name for s in specs))
    tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "store")
    other = plan_dataset(spec, open_source(place), FakeTokenizer(), HeldOut(max_val_fraction=0.5), rate=2.0)
    (line,) = differences(tmp_path / "store", other)
    assert line == "settings.max_val_fraction: 0.25 -> 0.5"


# --- What does not fit, and damage -----------------------------------------------------------


def test_parts_that_do_not_fit_each_other_are_refused_by_both_places(places, tmp_path):
    other = write_rlds(tmp_path, make_spec("wide", (5,)), [8] * 3)
    with pytest.raises(ConfigError) as error:
        tokenize_dataset(ARM, Parts("arm", (places[2], other)), FakeTokenizer(), tmp_path / "store")
    for words in (
        f"{other}/features.json, but 3 were expected",
        f"shards ({places[2]}/features.json)",
        "leave wide out",
    ):
        assert words in str(error.value)
    fast = write_robomimic(tmp_path / "fast.hdf5")
    with pytest.raises(ConfigError, match=rf"different rates: {places[0]} at 10 Hz, {fast} at 20 Hz. Leave one"):
        join((places[2], places[0], fast))


def test_damaged_episodes_of_all_parts_count_together_and_say_which_part(tmp_path):
    def spoil(episode, features):
        if episode == 1:
            features["steps/observation/image"][2] = b"no image"

    places = {}
    for copy in ("here", "there"):
        root = tmp_path / copy
        rlds = [write_rlds(root, make_spec(name), [8] * 6, change=spoil) for name in ("one", "two")]
        places[copy] = Parts("all", tuple(rlds))
    spec, made = replace(make_spec("all"), joins=("one", "two")), []
    with pytest.raises(EpisodeError, match="one, episode 1 "):
        tokenize_dataset(spec, places["here"], FakeTokenizer(), tmp_path / "a", frame_step=1)
    for copy, place in places.items():
        how = {"frame_step": 1, "corrupt": "skip"}
        with pytest.raises(DataError, match="all: 2 episodes cannot be used, more than max_skipped=1"):
            tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "b" / copy, max_skipped=1, **how)
        with pytest.raises(DataError, match="more than max_skipped=1"):  # a share of all twelve
            tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "b" / copy, max_skipped=0.1, **how)
        made.append(tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "c" / copy, max_skipped=2, **how))
        assert made[-1].skipped_count == 2 and not {1, 7} & {*made[-1].train.episodes, *made[-1].val.episodes}
    assert made[0].hash() == made[1].hash()
    shard = places["here"].places[1] / "two-train.tfrecord-00000-of-00001"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    lost = open_source(places["here"], corrupt="skip")
    assert sum(lost.skipped.values()) > 1 and lost.numbers[6] == 6
    (reason,) = lost.skipped
    assert lost.without_location(reason).startswith("two/two-train.tfrecord-00000-of-00001: ")
    with pytest.raises(DataError, match="all: .* more than max_skipped=1"):
        open_source(places["here"], corrupt="skip", max_skipped=1)
    shard = places["there"].places[0] / "one-train.tfrecord-00000-of-00001"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    lost = open_source(places["there"], corrupt="skip")  # those of the other part keep their numbers
    assert len(lost) < 12 and lost.numbers[-6:].tolist() == [6, 7, 8, 9, 10, 11]
