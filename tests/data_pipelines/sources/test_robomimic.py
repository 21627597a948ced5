"""Robomimic files where they lie: frames block by block, masks, fingerprints and damage."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.open import find_format, open_source, read_rate, source_name
from data_pipelines.sources.robomimic import RobomimicSource
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import demo_actions, number, write_robomimic
from tests.data_pipelines.fakes import FakeTokenizer
from tests.data_pipelines.tokenizing import tokenize_dataset

VIEW = DatasetSpec("robomimic_lift", "observation/agentview", ("action",), (7,), 20)


def test_the_name_and_the_rate_of_a_robomimic_file_need_no_demonstration(tmp_path):
    path = write_robomimic(tmp_path / "image.hdf5", images=False)
    assert (source_name(path), read_rate(path)) == ("robomimic_lift", 20)


def test_robomimic_is_read_where_it_lies(tmp_path):
    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 23, 4))
    assert find_format(path) == "robomimic" and source_name(str(path)) == "robomimic_lift"
    for source in (open_source(path), pickle.loads(pickle.dumps(open_source(path)))):
        assert (source.name, source.hz, source.steps().tolist()) == ("robomimic_lift", 20, [5, 23, 4])
        source.check_keys(VIEW.image_key, VIEW.action_keys, VIEW.action_dims)
        for k, steps in enumerate((5, 23, 4)):
            episode = source.episode(k, VIEW.image_key, VIEW.action_keys)
            assert [number(image) for image in episode.images] == [24 * k + t for t in range(steps)]
            np.testing.assert_array_equal(episode.actions, demo_actions(k, steps).astype(np.float32))
            assert episode.success is (k != 1)
            assert all(image.base is None for image in episode.images)  # none keeps those read with it in memory
        backward = source.frames(1, "observation/robot0_eye_in_hand", lambda n: [0, 22, 1])
        assert [number(image) for image in backward] == [46, 24, 45]
    some = open_source(path, "valid")
    assert some.episode(0, VIEW.image_key, ()).steps == 23 and some.ids.tolist() == [open_source(path).ids[1]]


def test_the_frames_of_a_robomimic_record_are_read_block_by_block(tmp_path):
    """Files that were compressed have chunks of a hundred frames: one frame after the other took a hundred times as
    long. A camera that is no camera in one demonstration says so when its frames are asked for."""

    def compress(file):
        for camera in ("agentview", "robot0_eye_in_hand"):
            obs = file["data/demo_10/obs"]
            frames = obs[f"{camera}_image"][()]
            del obs[f"{camera}_image"]
            obs.create_dataset(f"{camera}_image", data=frames, chunks=(20, 32, 32, 3), compression="gzip")
        del obs["robot0_eye_in_hand_image"]
        obs["robot0_eye_in_hand_image"] = frames.astype(np.uint16)
        del file["data/demo_11/obs/robot0_eye_in_hand_image"]

    source = open_source(write_robomimic(tmp_path / "image.hdf5", lengths=(5, 70, 4), change=compress))
    record = source.record(1, keys := ["steps/observation/agentview", "steps/observation/robot0_eye_in_hand"])
    shown, spoilt = (record[key] for key in keys)
    assert [number(frame) for frame in shown] == [24 + t for t in range(70)]
    assert shown.nbytes == 70 * 32 * 32 * 3 and len(spoilt) == 70
    with pytest.raises(EpisodeError, match=r"demo_10/obs/robot0_eye_in_hand_image is uint16 \[70, 32, 32, 3\]"):
        spoilt[0]
    assert source.record(2, keys).keys() == {keys[0]}, "absent, like any other field that it lacks"


def test_the_masks_of_a_robomimic_file_can_say_what_is_held_out(tmp_path):
    def share(file):
        file["mask/half"] = np.array([b"demo_9", b"demo_10"])

    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4), change=share)
    spec = replace(VIEW, split="train+valid", val_split="valid")
    manifest = tokenize_dataset(spec, path, FakeTokenizer(), tmp_path / "store", frame_step=1)
    assert (manifest.train.steps, manifest.val.steps) == ((5, 4), (7,))
    assert open_source(path, "train+valid").ids.tolist() == open_source(path).ids.tolist()
    with pytest.raises(DataError, match="mask/train and mask/half both name 'demo_9'"):
        open_source(path, "train+half")
    with pytest.raises(ConfigError, match="no mask 'test'; it has half, train, valid"):
        open_source(path, "train+test")


def test_what_is_lost_of_a_robomimic_file_does_not_say_where_it_lies(tmp_path):
    """The hash of a token store covers it."""

    def spoil(file):
        del file["data/demo_10/obs"]

    made = []
    for place in ("here", "there"):
        (tmp_path / place).mkdir()
        path = write_robomimic(tmp_path / place / "image.hdf5", lengths=(5, 7, 4, 6), change=spoil)
        made.append(tokenize_dataset(VIEW, path, FakeTokenizer(), tmp_path / place / "store", corrupt="skip"))
    assert made[0].skipped[0].reason.startswith("image.hdf5: data/demo_10/obs/agentview_image is not there")
    assert made[0].hash() == made[1].hash()


def test_pictures_of_a_robomimic_file_that_are_drawn_anew_are_another_source(tmp_path):
    """Of the same states and as many bytes: tokens and conversions of those before were taken for theirs."""

    def redraw(file):
        for demo in file["data"].values():
            demo["obs/agentview_image"][...] = 255 - demo["obs/agentview_image"][...]

    before = write_robomimic(tmp_path / "image.hdf5")
    (tmp_path / "new").mkdir()
    after = write_robomimic(tmp_path / "new" / "image.hdf5", change=redraw)
    assert before.stat().st_size == after.stat().st_size
    assert open_source(before).fingerprint() != open_source(after).fingerprint()
    assert RobomimicSource(before).identity() != RobomimicSource(after).identity()


def test_damage_inside_of_a_robomimic_file_is_named(tmp_path):
    """Of each of its lists of names, whatever h5py then raises; the other demonstrations are still there."""
    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4, 6))
    sound, told, kept = path.read_bytes(), 0, []
    for place in re.finditer(b"HEAP|SNOD", sound):
        path.write_bytes(sound[: place.start()] + b"gone" + sound[place.end() :])
        try:
            source, lost = open_source(path, corrupt="skip"), 0
            assert source.fingerprint()
        except DataError as error:
            told += "image.hdf5 is damaged" in str(error)
            continue
        for i in range(4):
            try:
                source.episode(i, VIEW.image_key, VIEW.action_keys)
            except EpisodeError as error:
                assert "image.hdf5: data/demo_" in str(error)
                lost += 1
        kept.append(lost)
    assert told >= 2 and kept.count(1) >= 4 and max(kept) == 1


def test_actions_that_are_texts_are_damage(tmp_path):
    def spoil(file):
        del file["data/demo_10/actions"]
        file["data/demo_10/actions"] = np.full((7, 7), b"left")

    source = open_source(write_robomimic(tmp_path / "image.hdf5", change=spoil))
    with pytest.raises(EpisodeError, match="demo_10: 'steps/action' contains no numbers, but [|]S4"):
        source.episode(1, VIEW.image_key, VIEW.action_keys)
