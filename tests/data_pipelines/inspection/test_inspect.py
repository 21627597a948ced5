"""What inspection says of directories whose contents are known, and the entries it suggests."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.inspection.action_stats import dimension_facts
from data_pipelines.inspection.duplicates import find_duplicates
from data_pipelines.inspection.inspect import NOT_READ, CameraFacts, inspect_dataset
from data_pipelines.inspection.issues import find_issues
from data_pipelines.inspection.suggest import choose_camera, suggest_entry, window_facts
from data_pipelines.registry import get_spec
from data_pipelines.registry.own import OWN
from data_pipelines.registry.toml_file import load_entries
from data_pipelines.sources.lerobot_dataset import LeRobotDataset
from data_pipelines.sources.rlds.dataset import RldsDataset
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import HEIGHT, WIDTH, picture, write_lerobot, write_robomimic
from tests.data_pipelines.fakes import REAL_DATA, make_spec, png, write_rlds

LENGTHS = [6, 7, 8, 9, 10, 11]


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """Actions: episode, step, and a flag that rises at the end."""

    def change(episode, features):
        features["steps/action"][-1, 2] = 1

    root = tmp_path_factory.mktemp("toy")
    return write_rlds(root, make_spec("toy", (3,)), LENGTHS, shards=2, change=change)


def camera(name: str, blank: bool = False) -> CameraFacts:
    return CameraFacts(f"observation/{name}", ((8, 8),), 4, 4 if blank else 0, still=blank)


def column(*values: float) -> np.ndarray:
    return np.array(values, np.float32)[:, None]


def hint(*episodes: np.ndarray) -> str:
    (facts,) = dimension_facts(episodes)
    return facts.hint


# --- facts ------------------------------------------------------------------------------------


def test_counts_lengths_and_schema_of_a_known_directory(toy):
    facts = inspect_dataset(toy).facts
    assert (facts.name, facts.version, facts.episodes, facts.sampled) == ("toy", "1.0.0", 6, 6)
    assert [(s.name, s.episodes, s.shards) for s in facts.splits] == [("train", 6, 2)]
    assert sorted(facts.steps) == LENGTHS
    assert (facts.lengths.shortest, facts.lengths.longest, facts.lengths.mean) == (6, 11, 8.5)
    kinds = {f.key: (f.kind, f.shape, f.dtype, f.per_step) for f in facts.fields}
    assert kinds["observation/image"] == ("image", (8, 8, 3), "uint8", True)
    assert kinds["action"] == ("number", (3,), "float32", True)
    assert kinds["language_instruction"][0] == "text"
    assert kinds["episode_metadata/success"][3] is False


def test_action_statistics_are_those_of_all_sampled_steps(toy):
    facts = inspect_dataset(toy).facts
    (action,) = facts.actions
    steps = np.concatenate([np.arange(n) for n in LENGTHS])
    index, step, flag = action.dimensions
    assert (step.minimum, step.maximum) == (0, 10)
    assert step.mean == pytest.approx(steps.mean()) and step.std == pytest.approx(steps.std())
    assert flag.mean == pytest.approx(6 / len(steps)) and flag.hint == "end flag"
    assert index.distinct == 6


def test_sample_is_bounded_in_episodes_and_bytes(toy):
    sample = inspect_dataset(toy, episodes=3, max_examples=2)
    facts, examples = sample.facts, sample.examples
    assert (facts.sampled, facts.episodes, len(examples)) == (3, 6, 2)
    assert inspect_dataset(toy, episodes=3).facts.steps == inspect_dataset(toy, episodes=3).facts.steps
    facts = inspect_dataset(toy, max_bytes=1).facts
    assert facts.sampled == 1 and facts.stopped and not sample.facts.stopped


@pytest.mark.parametrize(
    "asked, message", [({"episodes": 0}, "episodes .* 1, got 0"), ({"frames": 1}, "frames .* 2, got 1")]
)
def test_too_few_episodes_or_frames_are_refused_each_by_its_name(toy, asked, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        inspect_dataset(toy, **asked)


def test_frames_that_are_read_one_by_one_count_as_what_is_read(tmp_path):
    """Of a video its pixels; of images in a table, and of an HDF5 file, all that lies in the group that is read."""
    pytest.importorskip("av")
    frame = HEIGHT * WIDTH * 3
    places = {
        write_lerobot(tmp_path / "video", "v3.0", lengths=(12, 9, 10)): frame * 8,
        write_lerobot(tmp_path / "images", "v2.1", lengths=(12, 9, 10), camera="image"): 12 * len(png(picture(0))) // 2,
        write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4)): 4 * 2 * 32 * 32 * 3,
    }
    for place, least in places.items():
        facts = inspect_dataset(place, max_bytes=least // 2).facts
        assert facts.sampled == 1 < facts.episodes == 3 and facts.bytes_read > least // 2


def test_shown_frames_are_those_of_their_times(toy):
    for example in inspect_dataset(toy, frames=3).examples:
        assert example.times[0] == 0 and example.times[-1] == example.steps - 1
        assert example.instruction == "push" and example.success is bool(example.index % 2)
        (frames,) = example.frames.values()
        assert [f[0, 0].tolist() for f in frames] == [[example.index, t, 0] for t in example.times]


def test_blank_camera_is_recognised_and_not_offered_as_a_target(tmp_path):
    def change(episode, features):
        features["steps/observation/image"] = [png(np.full((8, 8, 3), 9, np.uint8))] * 5

    directory = write_rlds(tmp_path, make_spec(), [5, 5], change=change)
    facts = inspect_dataset(directory).facts
    assert facts.cameras[0].is_blank and facts.cameras[0].still
    assert "video_targets = false\n" in suggest_entry(facts, 4).table()


def test_damaged_episode_is_counted_not_fatal(tmp_path):
    def change(episode, features):
        if episode == 1:
            features["steps/action"] = features["steps/action"][:-1]
        if episode == 2:
            features["steps/observation/image"][0] = b"no image"

    facts = inspect_dataset(write_rlds(tmp_path, make_spec(), [5, 5, 5, 5], change=change)).facts
    assert facts.sampled == 2 and sum(facts.damaged.values()) == 2
    first, second = sorted(facts.damaged)
    file = "toy-train.tfrecord-00000-of-00001"
    assert first.startswith(f"{file}, episode 1: its fields differ in length") and "action 4" in first
    assert second.startswith(
        f"{file}, episode 2: step 0 of observation/image cannot be decoded: 8 bytes that are no JPEG, PNG, WebP or BMP image"
    )


def test_actions_of_another_width_than_declared_are_told_by_their_width(tmp_path):
    """Four values at each of 5 steps were "action 6.66667"."""

    def change(episode, features):
        if episode == 1:
            features["steps/action"] = np.zeros(20, np.float32)

    facts = inspect_dataset(write_rlds(tmp_path, make_spec(), [5, 5, 5], change=change)).facts
    (reason,) = facts.damaged
    assert reason.endswith("(observation/image 5, action 6.66667 of 3 values, or 5 of 4)")


def test_damage_is_told_without_advice_for_other_commands(tmp_path):
    """A way to leave it out is advised where it is read for a study; here it is left out already."""
    directory = write_rlds(tmp_path, make_spec(), [5] * 3)
    shard = directory / "toy-train.tfrecord-00000-of-00001"
    content = bytearray(shard.read_bytes())
    content[300] ^= 1
    shard.write_bytes(content)
    (reason,) = inspect_dataset(directory).facts.damaged
    assert reason.endswith("the checksum of the record's data does not match.")
    shard.write_bytes(content[: len(content) // 3 - 9])
    with pytest.raises(DataError, match="no readable episode") as raised:
        inspect_dataset(directory)
    assert "skip" not in str(raised.value)


@pytest.mark.parametrize("spoilt", [{2}, set(range(4))])
def test_a_camera_that_cannot_be_decoded_costs_no_episode(tmp_path, spoilt):
    """The whole episode was called damaged, and a dataset with one such camera unreadable; a study takes one camera."""
    from tensorflow_datasets import features as tf

    def change(episode, features):
        frames = [png(np.eye(8, dtype=np.uint8) * 40 * t) for t in range(1, 6)]
        features["steps/observation/image"] = frames
        features["steps/observation/a_wrist"] = [b"no image"] * 5 if episode in spoilt else frames

    directory = write_rlds(tmp_path, make_spec(), [5] * 4, change=change)
    cameras = {name: tf.Image(shape=(8, 8, 3)) for name in ("image", "a_wrist")}
    step = {"observation": cameras, "action": tf.Tensor(shape=(3,), dtype=np.float32)}
    tf.FeaturesDict({"steps": tf.Dataset(step)}).save_config(str(directory))
    sample = inspect_dataset(directory)
    facts = sample.facts
    assert facts.sampled == 4 and not facts.damaged and len(sample.fingerprints) == 4
    bad, good = facts.cameras
    assert (good.frames, good.undecodable) == (20, 0)
    assert (bad.frames, bad.undecodable, bad.is_blank) == (5 * (4 - len(spoilt)), len(spoilt), False)
    assert "step 0 of observation/a_wrist cannot be decoded: 8 bytes" in bad.reason
    assert all(len(example.frames) == 2 - (example.index in spoilt) for example in sample.examples)
    assert choose_camera(facts.cameras)[0] == good
    for key, kind in ((good.key, "warning"), (bad.key, "error")):
        issues = find_issues(facts, replace(make_spec(), image_key=key), None, ())
        (said,) = [r for r in issues if r.title == "undecodable frames"]
        assert (
            said.severity == kind
            and f"frames of {len(spoilt)} of 4 episodes are missing or cannot be decoded; the first: " in said.text
        )


def test_episodes_keep_their_numbers_behind_a_shard_that_is_cut_off(tmp_path):
    def change(episode, features):
        if episode == 4:
            features["steps/action"] = features["steps/action"][:-1]

    directory = write_rlds(tmp_path, make_spec(), [5] * 6, shards=2, change=change)
    first = directory / "toy-train.tfrecord-00000-of-00002"
    os.truncate(first, first.stat().st_size - 1)
    sample = inspect_dataset(directory, max_examples=4)
    assert sorted(example.index for example in sample.examples) == [0, 1, 3, 5]
    assert any(r.startswith("toy-train.tfrecord-00001-of-00002, episode 1: its fields") for r in sample.facts.damaged)


def test_steps_that_hold_lists_of_numbers_are_read(tmp_path):
    """As plans of some actions each: tfds keeps them under other keys, and not so many values of them per step."""
    from tensorflow_datasets import features as tf

    def change(episode, features):
        lengths = 1 + np.arange(6) % 3
        features["steps/action_plan/ragged_flat_values"] = np.zeros(2 * lengths.sum(), np.float32)
        features["steps/action_plan/ragged_row_lengths_0"] = lengths

    directory = write_rlds(tmp_path, make_spec(), [6, 6], change=change)
    plan = tf.Sequence(tf.Tensor(shape=(2,), dtype=np.float32))
    step = {"observation": {"image": tf.Image(shape=(8, 8, 3))}, "action": tf.Tensor(shape=(3,), dtype=np.float32)}
    tf.FeaturesDict({"steps": tf.Dataset(step | {"action_plan": plan})}).save_config(str(directory))
    facts = inspect_dataset(directory).facts
    assert [a.key for a in facts.actions] == ["action"] and facts.steps == (6, 6) and not facts.damaged
    assert {f.key: (f.kind, f.shape) for f in facts.fields}["action_plan"] == ("list", (None, 2))


def test_a_grey_camera_is_one(tmp_path):
    """It was called a depth, and the dataset one without a camera; with an entry by hand it could be trained on."""

    def change(episode, features):
        features["steps/observation/image"] = [png(np.eye(8, dtype=np.uint8) * 40 * t) for t in range(1, 6)]

    directory = write_rlds(tmp_path, make_spec(), [5, 5], change=change)
    path = directory / "features.json"
    path.write_text(re.sub(r'("dimensions": \[\s*"8",\s*"8",\s*)"3"', r'\1"1"', path.read_text()))
    facts = inspect_dataset(directory).facts
    assert {f.key: (f.kind, f.shape) for f in facts.fields}["observation/image"] == ("image", (8, 8, 1))
    assert suggest_entry(facts, 4).image_key == "observation/image" and not facts.damaged
    image = RldsDataset(directory).episode(0, "observation/image", ("action",)).images[1]
    np.testing.assert_array_equal(image, np.repeat(np.eye(8, dtype=np.uint8)[..., None] * 80, 3, -1))


def test_pictures_of_lerobot_that_are_no_cameras_are_named(tmp_path):
    """A grey camera and a depth beside one of three colours were left out without a word."""
    root = write_lerobot(tmp_path / "toy", "v2.1", camera="image")
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    depth = {"dtype": "image", "shape": [4, 6, 3], "info": {"video.is_depth_map": True}}
    info["features"] |= {"observation.images.ir": {"dtype": "image", "shape": [8, 8, 1]}, "observation.depth": depth}
    path.write_text(json.dumps(info))
    facts = inspect_dataset(root).facts
    left = {f.key: f.shape for f in facts.fields if f.kind == NOT_READ}
    assert left == {"observation/ir": (8, 8, 1), "observation/depth": (4, 6, 3)}
    assert "not used as cameras: observation/ir, observation/depth" in " ".join(suggest_entry(facts, 10).reasons)
    assert [c.key for c in facts.cameras] == ["observation/top"]
    with pytest.raises(ConfigError, match="'observation/ir' is not an image; images: observation/top"):
        LeRobotDataset(root).check_keys("observation/ir", ("action",))


def test_pictures_of_robomimic_that_are_no_cameras_are_named(tmp_path):
    def change(file):
        for demo in file["data"].values():
            demo["obs/wrist_rgb"] = demo["obs/agentview_image"][:]

    facts = inspect_dataset(write_robomimic(tmp_path / "toy.hdf5", change=change)).facts
    assert {f.key: f.shape for f in facts.fields if f.kind == NOT_READ} == {"observation/wrist_rgb": (32, 32, 3)}
    assert len(facts.cameras) == 2


def test_actions_that_are_kept_as_bytes_are_told_and_not_called_damage(tmp_path):
    """All episodes could not be read: their action held bytes."""
    from tensorflow_datasets import features as tf

    def change(episode, features):
        features["steps/action"] = [row.tobytes() for row in features["steps/action"]]

    directory = write_rlds(tmp_path, make_spec(), [5, 5], change=change)
    step = {"image": tf.Image(shape=(8, 8, 3)), "depth": tf.Tensor(shape=(4, 4), dtype=np.float32, encoding="zlib")}
    action = tf.Tensor(shape=(3,), dtype=np.float32, encoding="bytes")
    tf.FeaturesDict({"steps": tf.Dataset({"observation": step, "action": action})}).save_config(str(directory))
    facts = inspect_dataset(directory).facts
    kinds = {f.key: f.kind for f in facts.fields}
    assert (kinds["action"], kinds["observation/depth"], facts.damaged) == ("bytes", "bytes", {})
    suggestion = suggest_entry(facts, 4)
    assert not suggestion.action_keys and "action is stored as bytes, which cannot be read" in " ".join(
        suggestion.reasons
    )
    with pytest.raises(ConfigError, match="'action' in .*features.json is stored as bytes .encoding 'bytes'."):
        RldsDataset(directory).check_keys("observation/image", ("action",))


@pytest.mark.parametrize(
    "name, shape, reason",
    [
        (
            "left_action",
            (3,),
            "no numeric field `action`; give the fields of the action in action_keys, from left_action",
        ),
        ("action", (None,), "action has no fixed length, so it cannot be read"),
    ],
)
def test_actions_that_are_not_taken_are_told(tmp_path, name, shape, reason):
    """They were not: a dataset of robots became video alone, for want of a field of the usual name and form."""
    from tensorflow_datasets import features as tf

    def change(episode, features):
        features[f"steps/{name}"] = features.pop("steps/action")

    directory = write_rlds(tmp_path, make_spec(), [5, 5], change=change)
    step = {"observation": {"image": tf.Image(shape=(8, 8, 3))}, name: tf.Tensor(shape=shape, dtype=np.float32)}
    tf.FeaturesDict({"steps": tf.Dataset(step)}).save_config(str(directory))
    suggestion = suggest_entry(inspect_dataset(directory).facts, 4)
    assert not suggestion.action_keys and f"action: {reason}" in " ".join(suggestion.reasons)


def test_records_that_are_no_episodes_are_told(tmp_path):
    """As the pictures and labels of most other datasets of tfds."""
    from tensorflow_datasets import features as tf

    directory = write_rlds(tmp_path, make_spec(), [5] * 2)
    tf.FeaturesDict({"image": tf.Image(shape=(8, 8, 3)), "label": tf.Text()}).save_config(str(directory))
    with pytest.raises(DataError, match=r"features.json: none of its fields \(image, label\) is below `steps`"):
        inspect_dataset(directory)


def test_a_camera_or_a_field_that_a_study_does_not_take_costs_no_episode(tmp_path):
    """Tokenising reads them all. Such episodes were called damaged, and it was advised to leave damaged ones out."""
    from tensorflow_datasets import features as tf

    def change(episode, features):
        frames = features["steps/observation/image"]
        features["steps/observation/wrist"] = frames[: 0 if episode == 1 else 4]
        if episode != 2:
            features["steps/action_dict/gripper"] = np.arange(5, dtype=np.float32)

    directory = write_rlds(tmp_path, make_spec(), [5] * 4, change=change)
    cameras = {name: tf.Image(shape=(8, 8, 3)) for name in ("image", "wrist")}
    action, gripper = (tf.Tensor(shape=(size,), dtype=np.float32) for size in (3, 1))
    step = {"observation": cameras, "action": action, "action_dict": {"gripper": gripper}}
    tf.FeaturesDict({"steps": tf.Dataset(step)}).save_config(str(directory))
    sample = inspect_dataset(directory)
    facts = sample.facts
    assert facts.sampled == 4 and not facts.damaged and not find_duplicates(sample.fingerprints)
    image, wrist = facts.cameras
    assert (image.undecodable, wrist.undecodable) == (0, 4)
    assert "episode 0: observation/wrist has 4 frames, but there are 5 steps" in wrist.reason
    assert {action.key: len(action.dimensions) for action in facts.actions} == {"action": 3, "action_dict/gripper": 1}
    assert [len(example.actions) for example in sorted(sample.examples, key=lambda e: e.index)] == [2, 2, 1, 2]
    used = inspect_dataset(directory, action_keys=["action_dict/gripper"]).facts
    assert used.sampled == 3 and "action_dict/gripper 0" in next(iter(used.damaged))


def test_an_instruction_in_numbers_is_no_text(tmp_path):
    """As some datasets keep the ids of its tokens."""
    numbers = {"steps/language_instruction": np.arange(20)}
    directory = write_rlds(tmp_path, make_spec(), [10] * 2, change=lambda _, features: features.update(numbers))
    assert [example.instruction for example in inspect_dataset(directory).examples] == ["", ""]


def test_directory_without_a_usable_episode(tmp_path):
    def change(episode, features):
        features["steps/action"] = features["steps/action"][:-1]

    directory = write_rlds(tmp_path, make_spec(), [5] * 8, change=change)
    with pytest.raises(DataError, match="no episode of split 'train' can be read: .*differ in length") as raised:
        inspect_dataset(directory)
    assert str(raised.value).count("differ in length") == 6 and str(raised.value).endswith("; 2 more")


def test_unknown_split_lists_those_there(toy):
    with pytest.raises(ConfigError, match="no split 'val'.*; it has train"):
        inspect_dataset(toy, "val")


# --- hints ------------------------------------------------------------------------------------


def test_hints_name_what_the_numbers_look_like():
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=(200, 1)), axis=0)
    assert hint(column(3, 3, 3), column(3, 3)) == "constant"
    assert hint(column(0, 0, 1), column(0, 1)) == "end flag"
    assert hint(column(0, 1, 1, 0, 1), column(1, 0)) == "switch"
    assert hint(rng.normal(size=(200, 1))) == "delta"
    assert hint(walk) == "absolute"
    assert hint(5 + 0.1 * rng.normal(size=(200, 1))) == "absolute"
    assert hint((walk / 3 + np.pi) % (2 * np.pi) - np.pi) == "wrapping angle"


@pytest.mark.parametrize("scale", [1.5, 2.5])
def test_noise_that_is_clipped_within_a_turn_is_no_wrapping_angle(scale):
    """Its smallest and largest values are a turn apart, and now and then follow each other."""
    noise = np.clip(np.random.default_rng(0).normal(scale=scale, size=(5000, 1)), -3, 3)
    assert np.abs(np.diff(noise, axis=0)).max() > 0.9 * 2 * np.pi
    assert hint(noise) == "delta" and hint(np.degrees(noise)) == "delta"


def test_constant_with_rounding_noise_is_dead():
    (facts,) = dimension_facts([np.float32(0.1) + np.float32([[0], [1e-8], [0]])])
    assert facts.hint == "constant" and np.isnan(facts.smoothness)


@pytest.mark.parametrize("values", [np.full(10, 1.7e18), 2.0**62 + 1024 * np.arange(10), np.full(10, 3e38)])
def test_values_too_large_to_tell_neighbours_apart_are_described(values):
    """Nanoseconds since 1970, and the largest number of a type as a sign of none."""
    (facts,) = dimension_facts([values[:, None]])
    assert (facts.minimum, facts.maximum, sum(facts.histogram)) == (values.min(), values.max(), 10)


def test_values_that_are_not_finite_are_counted_and_left_out():
    (facts,) = dimension_facts([column(1, np.nan, 3, np.inf)])
    assert (facts.minimum, facts.maximum, facts.mean, facts.not_finite) == (1, 3, 2, 2)


# --- suggestions ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cameras", "chosen"),
    [
        ([camera("wrist_image"), camera("image")], "image"),
        ([camera("hand_color_image"), camera("frontleft_fisheye_image")], "frontleft_fisheye_image"),
        ([camera("image_0", blank=True), camera("image_1")], "image_1"),
        ([camera("wrist_left"), camera("zed"), camera("exterior_1_left")], "exterior_1_left"),
        ([camera("hand_image")], "hand_image"),
        ([camera("front_depth"), camera("hand_image")], "hand_image"),
    ],
)
def test_camera_that_sees_from_outside_is_chosen(cameras, chosen):
    assert choose_camera(cameras)[0].key == f"observation/{chosen}"


def test_suggested_table_is_an_entry_that_reads_the_dataset(toy, tmp_path):
    facts = inspect_dataset(toy).facts
    suggestion = suggest_entry(facts, 4)
    (tmp_path / "my.toml").write_text(suggestion.table())
    (spec,) = load_entries(tmp_path / "my.toml")
    assert spec == suggestion.spec()
    assert (spec.action_keys, spec.action_dims, spec.hz) == (("action[:2]",), (2,), 4)
    assert (spec.episodes, spec.mean_steps) == (facts.episodes, round(np.mean(facts.steps), 1))


def test_without_a_rate_the_entry_says_where_it_is_missing(toy, tmp_path):
    facts = inspect_dataset(toy).facts
    suggestion, file = suggest_entry(facts, None), tmp_path / "my.toml"
    assert "hz = 0  # FILL IN" in suggestion.table() and any("--hz" in reason for reason in suggestion.reasons)
    file.write_text(suggestion.table())
    with pytest.raises(ConfigError, match="hz, the native rate, must be positive"):
        load_entries(file)
    file.write_text(suggestion.table().replace("hz = 0", "hz = 4"))
    assert load_entries(file) == (suggest_entry(facts, 4).spec(),)


def test_dict_actions_are_suggested_field_by_field(tmp_path):
    spec = make_spec("parts", (2, 1))
    suggestion = suggest_entry(inspect_dataset(write_rlds(tmp_path, spec, [5, 6])).facts, spec.hz)
    assert (suggestion.action_keys, suggestion.action_dims) == (spec.action_keys, spec.action_dims)


def test_actions_of_a_long_stride_are_no_embedding(tmp_path):
    spec = make_spec("chunks", (390,))
    suggestion = suggest_entry(inspect_dataset(write_rlds(tmp_path, spec, [5, 6])).facts, spec.hz)
    assert (suggestion.action_keys, suggestion.action_dims) == (("action",), (390,))


def test_real_dataset_gets_the_entry_it_has():
    facts = inspect_dataset(REAL_DATA).facts
    known = get_spec("bridge_dataset")
    assert known in OWN
    assert suggest_entry(facts, 5).spec().facts() == known.facts()


def test_windows_are_counted_over_the_sample(toy):
    windows = window_facts(inspect_dataset(toy).facts, stride=2, frames=4)  # 8 steps each, padded ones 4 or 6
    assert (windows.needed, windows.long_enough) == (4, 6)
    assert windows.total == pytest.approx(1 + 1 + 1 + 1 + 2 + 2)
