from __future__ import annotations

import json
import os
import pickle
import shutil

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, NoDatasetError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.sources.rlds.dataset import RldsDataset
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import REAL_DATA, make_spec, write_rlds
from tests.data_pipelines.shards import index_shard

SPEC = make_spec()
KEYS = (SPEC.image_key, SPEC.action_keys)


@pytest.fixture
def directory(tmp_path):
    """Six episodes in two shards."""
    return write_rlds(tmp_path, SPEC, [5, 6, 7, 8, 9, 10], shards=2)


def shards(directory):
    return sorted(directory.glob("*.tfrecord*"))


def flip(path, byte):
    data = bytearray(path.read_bytes())
    data[byte] ^= 1
    path.write_bytes(data)


# --- what is read ----------------------------------------------------------------------------


def test_episodes_are_random_access_over_all_shards(directory):
    dataset = RldsDataset(directory)
    assert len(dataset) == 6 and (dataset.name, dataset.version) == ("toy", "1.0.0")
    for i in (4, 0, 3):
        episode = dataset.episode(i, *KEYS)
        assert episode.steps == len(episode.images) == 5 + i
        assert [image[0, 0].tolist() for image in episode.images] == [[i, t, 0] for t in range(5 + i)]
        assert episode.actions.dtype == np.float32
        assert episode.actions[:, :2].tolist() == [[i, t] for t in range(5 + i)]
        assert episode.success is bool(i % 2)


def test_frame_step_thins_images_not_actions(directory):
    episode = RldsDataset(directory).episode(3, *KEYS, frame_step=3)
    assert [image[0, 0, 1] for image in episode.images] == [0, 3, 6]
    assert len(episode.actions) == 8


def test_dict_actions_are_joined_in_the_order_given(tmp_path):
    spec = make_spec("dicts", (2, 1, 3))
    dataset = RldsDataset(write_rlds(tmp_path, spec, [4, 4]))
    forward = dataset.episode(1, spec.image_key, spec.action_keys).actions
    assert forward.shape == (4, 6) and forward[:, 1].tolist() == [0, 1, 2, 3]
    backward = dataset.episode(1, spec.image_key, spec.action_keys[::-1]).actions
    assert backward[:, 5].tolist() == [0, 1, 2, 3]


def test_parent_directory_means_the_newest_version(tmp_path, directory):
    newer = directory.with_name("1.10.0")
    newer.mkdir()
    for path in directory.iterdir():
        (newer / path.name).write_bytes(path.read_bytes())
    info = json.loads((newer / "dataset_info.json").read_text()) | {"version": "1.10.0"}
    (newer / "dataset_info.json").write_text(json.dumps(info))
    directory.with_name("1.9.0").mkdir()  # incomplete: no dataset_info.json
    assert RldsDataset(directory.parent).version == "1.10.0"


def test_pickled_dataset_reads_the_same(directory):
    dataset = pickle.loads(pickle.dumps(RldsDataset(directory)))
    assert dataset.episode(5, *KEYS).steps == 10


def test_real_episode_is_read():
    episode = RldsDataset(REAL_DATA).episode(0, "observation/image_0", ("action",))
    assert episode.images[0].shape == (64, 64, 3) and episode.images[0].dtype == np.uint8
    assert episode.actions.shape == (10, 7) and episode.success is None


def test_fingerprint_tells_contents_apart_not_places(tmp_path):
    lengths = [5, 6]
    a = RldsDataset(write_rlds(tmp_path / "a", SPEC, lengths)).fingerprint()
    assert a == RldsDataset(write_rlds(tmp_path / "b", SPEC, lengths)).fingerprint()
    assert a != RldsDataset(write_rlds(tmp_path / "c", SPEC, [5, 7])).fingerprint()

    def change(episode, features):  # same number of bytes
        features["steps/action"][0, 0] = 9

    assert a != RldsDataset(write_rlds(tmp_path / "d", SPEC, lengths, change=change)).fingerprint()


# --- damage: one clear message each -----------------------------------------------------------


def test_empty_or_missing_directory(tmp_path):
    with pytest.raises(DataError, match="no such directory"):
        RldsDataset(tmp_path / "absent")
    with pytest.raises(DataError, match="holds nothing") as empty:
        RldsDataset(tmp_path)
    assert not isinstance(empty.value, NoDatasetError)  # its disk may not be mounted


def test_no_dataset_info(directory):
    (directory / "dataset_info.json").unlink()
    with pytest.raises(DataError, match="has a dataset_info.json"):
        RldsDataset(directory)


@pytest.mark.parametrize("file", ["dataset_info.json", "features.json"])
@pytest.mark.parametrize("content", ["", "{", "[]", "{}"])
def test_damaged_metadata(directory, file, content):
    (directory / file).write_text(content)
    with pytest.raises(DataError, match=f"{file}.* Restore the file as tfds wrote it"):
        RldsDataset(directory)


@pytest.mark.parametrize(
    ("content", "hz"),
    [
        ('{"hz": 2.5}', 2.5),
        ('{"hz": 0}', None),
        ('{"hz": "5"}', None),
        ('{"hz": NaN}', None),
        ("[]", None),
        ("{", None),
    ],
)
def test_the_rate_is_that_of_the_metadata_where_they_have_one(directory, content, hz):
    """What else is in the file, which others may have written, is no reason not to read the episodes."""
    assert RldsDataset(directory).hz is None
    (directory / "metadata.json").write_text(content)
    assert RldsDataset(directory).hz == hz


def test_missing_features(directory):
    (directory / "features.json").unlink()
    with pytest.raises(DataError, match="features.json is missing"):
        RldsDataset(directory)


def test_missing_shard(directory):
    shards(directory)[1].unlink()
    with pytest.raises(DataError, match=r"00001-of-00002: the shard is missing"):
        RldsDataset(directory)


def test_empty_shard(directory):
    shards(directory)[1].write_bytes(b"")
    with pytest.raises(DataError, match=r"00001-of-00002: it has 0 records.*says 3: the file is empty"):
        RldsDataset(directory)


@pytest.mark.parametrize("stated", ["2", "4"])
def test_count_that_contradicts_dataset_info(directory, stated):
    path = directory / "dataset_info.json"
    info = json.loads(path.read_text())
    info["splits"][0]["shardLengths"][0] = stated
    path.write_text(json.dumps(info))
    with pytest.raises(DataError, match=rf"00000-of-00002: it has 3 records, but dataset_info.json says {stated}"):
        RldsDataset(directory)


def test_truncated_shard(directory):
    shard = shards(directory)[0]
    shard.write_bytes(shard.read_bytes()[:-10])
    with pytest.raises(CorruptRecordError, match="truncated"):
        RldsDataset(directory)


def test_flipped_bit_in_a_record(directory):
    shard = shards(directory)[0]
    offset = int(index_shard(shard).offsets[1])
    flip(shard, offset + 100)
    dataset = RldsDataset(directory)
    dataset.episode(0, *KEYS)
    with pytest.raises(CorruptRecordError, match=rf"{shard.name}: corrupt record at byte {offset}"):
        dataset.episode(1, *KEYS)


def test_unknown_split(directory):
    with pytest.raises(ConfigError, match="no split 'test'.*; it has train"):
        RldsDataset(directory, "test")
    with pytest.raises(ConfigError, match=r"no split 'train\[:5\]'.* give 'train', .* --set store\.max_train=N\.$"):
        RldsDataset(directory, "train[:5]")


def test_wrong_image_key_lists_the_images(directory):
    with pytest.raises(ConfigError, match="images there: observation/image "):
        RldsDataset(directory).check_keys("observation/imgae", ("action",))
    with pytest.raises(ConfigError, match="'action' is not an image"):
        RldsDataset(directory).check_keys("action", ("action",))


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
def test_depths_are_no_camera(directory, dtype):
    """tfds keeps the bytes of float32 depths as the four channels of a PNG: they were read as colours."""
    from tensorflow_datasets import features as tf

    step = {"image": tf.Image(shape=(8, 8, 3)), "depth": tf.Image(shape=(8, 8, 1), dtype=dtype, encoding_format="png")}
    tf.FeaturesDict({"steps": tf.Dataset({"observation": step})}).save_config(str(directory))
    with pytest.raises(
        ConfigError, match=f"'observation/depth' holds depths .{dtype.__name__}.*images: observation/image[.]"
    ):
        RldsDataset(directory).check_keys("observation/depth", ())


def test_wrong_action_key_or_size(directory):
    dataset = RldsDataset(directory)
    with pytest.raises(ConfigError, match="no numeric field 'actoin'.*closest: action"):
        dataset.check_keys("observation/image", ("actoin",))
    with pytest.raises(ConfigError, match="'action' has 3 values per step.*but 7 were expected"):
        dataset.check_keys("observation/image", ("action",), (7,))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_actions_that_are_not_finite_name_the_step(tmp_path, value):
    def spoil(episode, features):
        if episode == 2:
            features["steps/action"][4, 1] = value

    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6, 6, 6], change=spoil))
    dataset.episode(1, *KEYS)
    with pytest.raises(EpisodeError, match="toy, episode 2 .*'steps/action' is not finite at step 4"):
        dataset.episode(2, *KEYS)


def test_values_that_an_entry_leaves_out_need_not_be_finite(tmp_path):
    def spoil(episode, features):
        features["steps/action"][:, 2] = np.nan

    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6], change=spoil))
    actions = dataset.episode(0, KEYS[0], ("action[:2]",)).actions
    np.testing.assert_array_equal(actions, [[0, t] for t in range(6)])
    with pytest.raises(EpisodeError, match=r"'steps/action\[1:\]' is not finite at step 0: \[0.0, nan\]"):
        dataset.episode(0, KEYS[0], ("action[1:]",))


def test_actions_and_frames_of_different_number(tmp_path):
    def spoil(episode, features):
        features["steps/action"] = features["steps/action"][:-1]

    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6], change=spoil))
    with pytest.raises(EpisodeError, match="15 values, but 6 frames of 3 need 18"):
        dataset.episode(0, *KEYS)


def test_frames_of_a_verified_episode_are_read_alone(tmp_path, monkeypatch):
    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6, 5]))
    first = dataset.frames(1, SPEC.image_key, lambda n: range(n))
    dataset = pickle.loads(pickle.dumps(dataset))
    monkeypatch.setattr("data_pipelines.sources.rlds.dataset.open_record", None)
    again = dataset.frames(1, SPEC.image_key, lambda n: [n - 1, 0])
    np.testing.assert_array_equal(again, [first[4], first[0]])
    with pytest.raises(TypeError):  # the other has to be opened
        dataset.frames(0, SPEC.image_key, lambda n: [0])


def test_shard_that_became_shorter_is_noticed_by_a_frame_read_alone(tmp_path):
    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6, 5]))
    for _ in range(2):  # as a whole, then alone from a file that stays open
        dataset.frames(1, SPEC.image_key, lambda n: [n - 1])
    shard = shards(dataset.directory)[0]
    os.truncate(shard, shard.stat().st_size // 2)
    with pytest.raises(CorruptRecordError, match=f"{shard.name}.*shorter since it was indexed"):
        dataset.frames(1, SPEC.image_key, lambda n: [n - 1])


def test_dataset_made_anew_does_not_read_the_old_one(tmp_path):
    """Files that stay open are those of one object: the next sees what lies there now."""
    directory, kept = tmp_path / SPEC.name, []
    for steps in (6, 5):
        kept.append(RldsDataset(write_rlds(tmp_path, SPEC, [steps, steps])))
        for _ in range(2):
            assert kept[-1].frames(1, SPEC.image_key, lambda n: [n - 1])[0][0, 0, 1] == steps - 1
        shutil.rmtree(directory)


def test_episode_without_frames_is_unusable(tmp_path):
    def spoil(episode, features):
        features |= {"steps/observation/image": [], "steps/action": np.zeros((0, 3), np.float32)}

    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6], change=spoil))
    for keys in (SPEC.action_keys, ()):
        with pytest.raises(EpisodeError, match="episode 0 .*no frames"):
            dataset.episode(0, SPEC.image_key, keys)


def test_fields_of_another_kind_than_the_schema_says_are_unusable(tmp_path):
    def spoil(episode, features):
        if episode == 0:
            features["steps/observation/image"] = np.zeros(6, np.float32)
        if episode == 1:
            features["steps/action"] = [b"x"] * 18

    directory = write_rlds(tmp_path, SPEC, [6, 6, 6], change=spoil)
    with pytest.raises(EpisodeError, match="episode 0 .*'steps/observation/image' holds numbers, not images"):
        RldsDataset(directory).episode(0, *KEYS)
    with pytest.raises(EpisodeError, match="episode 0 .*holds numbers, not images"):
        RldsDataset(directory).frames(0, SPEC.image_key, lambda n: [0])
    with pytest.raises(EpisodeError, match="episode 1 .*'steps/action' has 18 values"):
        RldsDataset(directory).episode(1, *KEYS)
    facts = inspect_dataset(directory).facts
    assert facts.sampled == 1 and sorted(facts.damaged.values()) == [1, 1]


def test_image_that_cannot_be_decoded_names_the_step(tmp_path):
    def spoil(episode, features):
        features["steps/observation/image"][3] = b"\xff\xd8\xff broken"
        features["steps/observation/image"][4] = b""

    dataset = RldsDataset(write_rlds(tmp_path, SPEC, [6], change=spoil))
    with pytest.raises(EpisodeError, match="episode 0 .*step 3 of 'steps/observation/image'"):
        dataset.episode(0, *KEYS)
    with pytest.raises(EpisodeError, match="that are no JPEG"):
        dataset.frames(0, SPEC.image_key, lambda n: [4])


# --- the policy 'skip' ------------------------------------------------------------------------


def test_skip_keeps_what_a_truncated_shard_still_holds(directory):
    shard = shards(directory)[0]
    shard.write_bytes(shard.read_bytes()[:-10])
    dataset = RldsDataset(directory, corrupt="skip")
    assert len(dataset) == 5 and sum(dataset.skipped.values()) == 1
    assert "truncated" in next(iter(dataset.skipped))
    assert dataset.episode(2, *KEYS).actions[0, 0] == 3  # the second shard's first


def test_skip_counts_a_missing_shard_in_full(directory):
    shards(directory)[1].unlink()
    dataset = RldsDataset(directory, corrupt="skip")
    assert len(dataset) == 3 and sum(dataset.skipped.values()) == 3


def test_skip_of_every_episode_says_what_is_wrong_with_them(directory):
    for shard in shards(directory):
        shard.unlink()
    with pytest.raises(
        DataError, match="no readable episode: .*00000-of-00002: the shard is missing. Download it again"
    ):
        RldsDataset(directory, corrupt="skip")


def test_skip_is_bounded(directory):
    shards(directory)[1].unlink()
    with pytest.raises(DataError, match="3 episodes cannot be used, more than max_skipped=2"):
        RldsDataset(directory, corrupt="skip", max_skipped=2)


@pytest.mark.parametrize(("share", "lost"), [(0.34, 2), (0.17, 1), (0.16, 0), (0, 0)])
def test_the_bound_may_be_a_share_of_the_episodes(directory, share, lost):
    dataset = RldsDataset(directory, corrupt="skip", max_skipped=share)
    assert dataset.max_skipped == lost
    for i in range(lost):
        dataset.skip(i, EpisodeError(f"episode {i} is broken"))
    with pytest.raises(DataError, match=f"more than max_skipped={lost}"):
        dataset.skip(lost, EpisodeError("one too many"))


@pytest.mark.parametrize("wrong", [1.5, -1, -0.1, float("inf"), float("nan")])
def test_a_bound_that_is_neither_a_number_nor_a_share_is_refused(directory, wrong):
    with pytest.raises(ConfigError, match="max_skipped must be a whole number"):
        RldsDataset(directory, corrupt="skip", max_skipped=wrong)


def test_skip_counts_an_episode_once(directory):
    dataset = RldsDataset(directory, corrupt="skip", max_skipped=1)
    dataset.skip(1, EpisodeError("step 3 of episode 1 is broken"))
    dataset.skip(1, EpisodeError("step 4 of episode 1 is broken"))
    assert dataset.skipped == {"step 3 of episode 1 is broken": 1}
    with pytest.raises(DataError, match="2 episodes cannot be used, more than max_skipped=1"):
        dataset.skip(2, EpisodeError("step 3 of episode 1 is broken"))  # in the same words


def test_raise_passes_the_error_on(directory):
    with pytest.raises(EpisodeError, match="broken"):
        RldsDataset(directory).skip(0, EpisodeError("broken"))


def test_an_empty_split_names_those_with_episodes(tmp_path):
    directory = write_rlds(tmp_path, make_spec(), [3, 3])
    path = directory / "dataset_info.json"
    info = json.loads(path.read_text())
    info["splits"].append({"name": "val", "shardLengths": []})
    path.write_text(json.dumps(info))
    with pytest.raises(
        DataError,
        match="split 'val' has no readable episode: by dataset_info.json it is empty; splits with episodes: train",
    ):
        RldsDataset(directory, "val")
