"""What stands out of a dataset: each issue on data made to have it and on data without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from data_pipelines.inspection.duplicates import Fingerprint, find_duplicates, take_fingerprint
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.inspection.issues import find_issues
from data_pipelines.inspection.suggest import window_facts
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.rlds.images import decode_image
from tests.data_pipelines.fakes import REAL_DATA, make_spec, png, write_rlds

SPEC = make_spec("toy", (3,))


def scene(seed: int, shift: int = 0) -> np.ndarray:
    """Blocks of colours, the same for one seed; `shift` moves them."""
    blocks = np.random.default_rng(seed).integers(0, 255, (8, 8, 3)).astype(np.uint8)
    return np.roll(np.kron(blocks, np.ones((8, 8, 1), np.uint8)), shift, axis=1)


def healthy(episode: int, features: dict) -> None:
    """A picture that moves and actions of every kind, different in every episode."""
    steps = len(features["steps/action"])
    features["steps/observation/image"] = [png(scene(episode, 2 * t)) for t in range(steps)]
    features["steps/action"][:] = np.random.default_rng(episode).normal(size=(steps, 3))


def issues_of(tmp_path, change=healthy, lengths=(20,) * 8, spec=SPEC, frames=4) -> dict[str, str]:
    def both(episode, features):
        healthy(episode, features)
        change(episode, features)

    directory = write_rlds(tmp_path, make_spec("toy", (3,)), list(lengths), change=both)
    sample = inspect_dataset(directory)
    windows = window_facts(sample.facts, 2, frames)
    found = find_issues(sample.facts, spec, windows, find_duplicates(sample.fingerprints))
    return {r.title: f"{r.severity}: {r.text}" for r in found}


def test_nothing_stands_out_of_healthy_data(tmp_path):
    assert issues_of(tmp_path) == {}


def test_no_window(tmp_path):
    assert issues_of(tmp_path, lengths=[2, 3], frames=4) == {
        "no window": "error: the shortest window at stride 2 needs 4 steps; the longest of 2 episodes has 3"
    }


def test_some_short_episodes(tmp_path):
    found = issues_of(tmp_path, lengths=[2, 3, 8, 9], frames=4)
    assert found["short episodes"].endswith("2 of 4 episodes are shorter")


def test_constant_actions(tmp_path):
    def change(episode, features):
        features["steps/action"][:, 1] = 0.25

    assert issues_of(tmp_path, change) == {"constant action": "warning: action: value 1 never changes"}


def test_errors_come_first(tmp_path):
    def change(episode, features):
        features["steps/observation/image"] = [png(np.full((8, 8, 3), 7, np.uint8))] * len(features["steps/action"])

    found = issues_of(tmp_path, change, lengths=[20, 1, 20, 20])
    severities = [text.partition(":")[0] for text in found.values()]
    assert {"single steps", "blank camera"} <= found.keys() and severities == sorted(severities), found


def test_blank_camera_in_use(tmp_path):
    def change(episode, features):
        features["steps/observation/image"] = [png(np.full((8, 8, 3), 7, np.uint8))] * 20

    found = issues_of(tmp_path, change)
    assert found["blank camera"].startswith("error: observation/image (the camera in use)")


def test_actions_and_frames_of_different_number(tmp_path):
    def change(episode, features):
        if episode == 2:
            features["steps/action"] = features["steps/action"][:-1]

    found = issues_of(tmp_path, change)
    assert found["cannot be read"].startswith("error: 1 of the episodes:") and "action 19" in found["cannot be read"]


def test_numbers_that_are_not_finite(tmp_path):
    def change(episode, features):
        if episode == 2:
            features["steps/action"][3, 0] = np.nan

    assert issues_of(tmp_path, change)["not finite"].startswith("error: action: value 0: 1 numbers are NaN")


def wrapping(episode: int, features: dict) -> None:
    features["steps/action"][:, 2] = (0.5 * np.arange(20) + np.pi) % (2 * np.pi) - np.pi


def test_angles_that_wrap_unless_the_entry_mends_them(tmp_path):
    found = issues_of(tmp_path / "a", wrapping)
    assert "value 2 jumps by a whole turn" in found["wrapping angle"] and "angles = [2]" in found["wrapping angle"]
    for form in ("sine_cosine", "unwrapped"):
        mended = replace(SPEC, angles=(2,), angle_form=form)
        assert "wrapping angle" not in issues_of(tmp_path / form, wrapping, spec=mended)


def test_angles_of_another_unit_than_the_entry_s(tmp_path):
    """Their sine and cosine would be those of other angles."""
    mended = replace(SPEC, angles=(2,), angle_form="sine_cosine")
    assert "unit of angles" not in issues_of(tmp_path / "a", wrapping, spec=mended)
    found = issues_of(tmp_path / "b", wrapping, spec=replace(mended, angle_unit="degree"))
    said = "error: action: value 2 jumps by a whole turn of 6.283; the entry's angle_unit is degree, not radian"
    assert found["unit of angles"] == said


def test_angles_are_numbered_as_the_entry_numbers_them(tmp_path):
    """Over all its keys, of which each may be a part of a field; fields that it leaves out have no number."""
    fields = make_spec("toy", (4, 7))

    def change(episode, features):
        actions = np.random.default_rng(episode).normal(size=(20, 11))
        actions[:, 9] = (0.5 * np.arange(20) + np.pi) % (2 * np.pi) - np.pi
        features["steps/action/part_0"], features["steps/action/part_1"] = np.split(actions, [4], axis=1)

    facts = inspect_dataset(write_rlds(tmp_path, fields, [20] * 8, change=change)).facts

    def wrapping_of(entry: DatasetSpec | None) -> list[str]:
        return [r.text for r in find_issues(facts, entry, None, ()) if r.title == "wrapping angle"]

    parts = replace(fields, action_keys=("action/part_0[:3]", "action/part_1[:6]"), action_dims=(3, 6))
    (text,) = wrapping_of(parts)
    assert text.startswith("action/part_1[:6]: value 5 jumps by a whole turn") and "angles = [8]" in text
    assert not wrapping_of(replace(parts, angles=(8,), angle_form="sine_cosine"))
    assert not wrapping_of(replace(parts, action_keys=("action/part_0[:3]",), action_dims=(3,)))
    (text,) = wrapping_of(None)
    assert text.startswith("action/part_1: value 5 jumps") and "angles = [5]" in text


def test_an_entry_that_names_what_is_not_there(tmp_path):
    wrong = replace(SPEC, image_key="observation/rgb", action_keys=("action[:9]",), action_dims=(9,))
    text = issues_of(tmp_path, spec=wrong)["entry does not fit"]
    assert text.startswith("error") and "needs observation/rgb, action[:9] with 9 values" in text


# --- duplicates ---------------------------------------------------------------------------------


def test_the_same_recording_twice(tmp_path):
    def change(episode, features):
        if episode in (3, 6):
            healthy(99, features)

    assert issues_of(tmp_path, change) == {
        "likely duplicates": "warning: 1 episodes are copies of another one: train 3 = train 6"
    }


@pytest.mark.parametrize("what", ["steps/action", "steps/observation/image"])
def test_one_of_pictures_and_actions_alone_makes_no_duplicate(tmp_path, what):
    def change(episode, features):
        if episode in (3, 6):
            other: dict = {"steps/action": np.zeros((20, 3), np.float32)}
            healthy(99, other)
            features[what] = other[what]

    assert issues_of(tmp_path, change) == {}


def test_pictures_decide_where_no_action_varies(tmp_path):
    def change(episode, features):
        healthy(episode % 4, features)
        features["steps/action"][:] = 0

    assert "4 episodes are copies of another one" in issues_of(tmp_path, change)["likely duplicates"]


def test_a_recording_is_known_again_compressed_and_smaller():
    """Real frames: one episode, the same at 5/8 of its size and as JPEG of quality 60, and another."""
    one, other = inspect_dataset(REAL_DATA, max_examples=2).examples

    def prints(index: int, change) -> Fingerprint:
        frames = {camera: [change(np.ascontiguousarray(f)) for f in shown] for camera, shown in one.frames.items()}
        return take_fingerprint("train", index, one.steps, frames, list(one.actions.values()))

    same = prints(0, lambda f: f)
    small = prints(1, lambda f: np.asarray(Image.fromarray(f).resize((40, 40), Image.Resampling.BOX)))
    jpeg = prints(2, lambda f: decode_image(simplejpeg.encode_jpeg(f, quality=60)))
    another = take_fingerprint("train", 3, other.steps, other.frames, list(other.actions.values()))
    (group,) = find_duplicates([same, another, small, jpeg])
    assert [e.index for e in group] == [0, 1, 2]


@pytest.mark.filterwarnings("error")
def test_an_infinite_value_makes_no_episodes_alike():
    actions = np.random.default_rng(0).normal(size=(4, 16, 1))
    actions[3, 5] = np.inf
    pictures = np.zeros((2, 16, 16))  # of a fixed camera
    assert find_duplicates([Fingerprint("train", i, 16, pictures, one) for i, one in enumerate(actions)]) == []


def test_real_episodes_are_not_taken_for_each_other():
    assert find_duplicates(inspect_dataset(REAL_DATA).fingerprints) == []
