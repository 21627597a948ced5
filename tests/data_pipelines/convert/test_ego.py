"""Ego4D and Ego-Exo4D in the published layouts: time, joining rules, colours, refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.errors import DataError
from data_pipelines.sources.human.ego4d import Ego4dSource
from data_pipelines.sources.human.egoexo4d import EgoExo4dSource
from data_pipelines.sources.settings import Ego4dSettings, EgoExo4dSettings
from tests.data_pipelines.convert.sources import HEIGHT, WIDTH, number, read_back, write_video

# --- Ego4D: a video of 10 frames per second, whose frame n is number n ---------------------------

UID = "0a1b"


def box(kind: str, x: float, y: float) -> dict:
    """Centre (x, y) in pixels of an image of 200 x 100."""
    return {
        "object_type": kind,
        "structured_noun": None,
        "bbox": {"x": x - 5, "y": y - 10, "width": 10, "height": 20},
    }


def annotated(n: int, hands=("left_hand", "right_hand")) -> dict:
    """Frame n: the left hand at x = n, the right one at x = 100 + n, both at half height."""
    places = {"left_hand": float(n), "right_hand": 100.0 + n}
    boxes = [box("object_of_change", 50, 50), *(box(hand, places[hand], 50) for hand in hands)]
    return {"frame_number": n, "frame_type": "pre_frame", "boxes": boxes}


def action(*frames: dict, **flags) -> dict:
    kinds = {
        "is_rejected": False,
        "is_invalid_annotation": False,
        "stage": "x",
        "narration_text": "#C C cuts",
    }
    return {**kinds, **flags, "frames": list(frames) or None}


def ego4d(tmp_path, *actions: dict, settings=Ego4dSettings(min_frames=3), length=48, **change):
    video = {
        "video_uid": UID,
        "video_metadata": {"fps": 10.0, "num_frames": length, "width": 200, "height": 100},
        "annotated_intervals": [{"start_sec": 0, "end_sec": 9, "narrated_actions": list(actions)}],
        **change,
    }
    path = tmp_path / "fho_main.json"
    path.write_text(json.dumps({"version": "2.1", "videos": [video, {**video, "video_uid": "elsewhere"}]}))
    write_video(tmp_path / "full_scale" / f"{UID}.mp4", list(range(length)), 10)
    return Ego4dSource(path, tmp_path / "full_scale", settings)


def test_annotated_frames_are_joined_in_time_and_sampled_evenly(tmp_path):
    first = action(annotated(13), annotated(5), annotated(10))  # not in the order of time
    second = action(annotated(10), annotated(20), annotated(26))  # shares a frame; ends off the grid
    source = ego4d(tmp_path, first, second)
    assert source.units == [UID]
    done = convert(source, tmp_path, "ego4d")
    assert done.spec.hz == 2
    dataset, (episode,) = read_back(done.directory, "observation/image")
    # 5, 10, 15, 20, 25: half a second each; 15 lies between the annotated 13 and 20, 25 before 26.
    assert [number(image) for image in episode.images] == [5, 10, 15, 20]
    expected = np.array([[n / 200, 0.5, (100 + n) / 200, 0.5] for n in (5, 10, 15, 20, 25)])
    np.testing.assert_allclose(episode.actions, expected[1:], atol=1e-6)
    np.testing.assert_allclose(dataset.record(0)["steps/observation/state"].reshape(-1, 4), expected[:-1], atol=1e-6)


def test_frames_are_counted_at_the_rate_of_the_annotations(tmp_path):
    """Not at that of a video which was encoded anew at another one: frame 20 of 20 per second is at 1 s."""
    frames, about = [annotated(n) for n in (0, 10, 20, 30, 40)], {"fps": 20.0, "width": 200, "height": 100}
    done = convert(ego4d(tmp_path, action(*frames), video_metadata=about), tmp_path, "ego4d")
    _, (episode,) = read_back(done.directory, "observation/image")
    assert [number(image) for image in episode.images] == [0, 5, 10, 15]  # the video has 10 per second
    np.testing.assert_allclose(episode.actions[:, 0] * 200, [10, 20, 30, 40], atol=1e-4)


def test_a_pause_ends_an_episode_and_unusable_frames_do_not_bridge_it(tmp_path):
    frames = [annotated(n) for n in (0, 5, 10)] + [annotated(n) for n in (30, 35, 40, 45)]
    middle = [annotated(20, ("left_hand",)), annotated(21, ())]  # without both hands
    rejected = action(annotated(15), annotated(25), is_rejected=True)
    invalid = action(annotated(16), annotated(24), is_invalid_annotation=True)
    done = convert(ego4d(tmp_path, action(*frames, *middle), rejected, invalid, action()), tmp_path, "ego4d")
    _, episodes = read_back(done.directory, "observation/image")
    assert [[number(i) for i in e.images] for e in episodes] == [[0, 5], [30, 35, 40]]


def test_short_stretches_are_left_out_and_counted(tmp_path):
    source = ego4d(tmp_path, action(*(annotated(n) for n in (0, 5, 10, 15, 40))))
    assert convert(source, tmp_path, "ego4d").skipped == {"fewer than 3 frames in a row with both hands": 1}


@pytest.mark.parametrize(
    "actions, change, message",
    [
        ((), {"annotated_intervals": None}, "0a1b has no 'annotated_intervals'"),
        ((action({"boxes": annotated(1)["boxes"]}),), {}, "0a1b, interval 0 has no 'frame_number'"),
        (
            (action({**annotated(4), "boxes": [{"object_type": "left_hand"}, box("right_hand", 9, 9)]}),),
            {},
            "0a1b, interval 0, frame 4, left_hand has no 'bbox'",
        ),
        (
            (action(*(annotated(n) for n in (30, 35, 40, 45, 50))),),
            {},
            r"0a1b.mp4: no frame at 4.0000 s|no frame at",
        ),
    ],
)
def test_malformed_annotations_are_named_to_the_field(tmp_path, actions, change, message):
    with pytest.raises(DataError, match=message):
        convert(ego4d(tmp_path, *actions, length=40, **change), tmp_path, "ego4d")


def test_ego4d_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(DataError, match="no list 'videos'"):
        Ego4dSource(tmp_path / "a.json", tmp_path)
    (tmp_path / "a.json").write_text('{"videos": [{"video_uid": "x"}]}')
    with pytest.raises(DataError, match="none of the 1 annotated videos as .*--videos"):
        Ego4dSource(tmp_path / "a.json", tmp_path)
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(DataError, match="a.json cannot be read"):
        Ego4dSource(tmp_path / "a.json", tmp_path)


# --- Ego-Exo4D: a downscaled copy of a 3840 x 2160 video -----------------------------------------

TAKE = {"take_uid": "uid-1", "take_name": "cooking_1", "cameras": []}


def pose(n: int, camera: str = "cam01") -> list[dict]:
    point = {"placement": "auto"}
    wrists = {
        "left_wrist": {"x": 30.0 * n, "y": 540.0, **point},
        "right_wrist": {"x": 1920.0 + 30 * n, "y": 1080.0, **point},
    }
    return [{"metadata": {"frame_number": n}, "annotation2D": {camera: wrists, "cam02": {}}, "annotation3D": {}}]


def egoexo4d(tmp_path, poses: dict, settings=EgoExo4dSettings(min_frames=10), fps=30, size=(HEIGHT, WIDTH)):
    (tmp_path / "takes.json").write_text(json.dumps([TAKE, {**TAKE, "take_uid": "uid-2", "take_name": "other"}]))
    path = tmp_path / "annotations/ego_pose/train/hand/automatic/uid-1.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(poses))
    write_video(tmp_path / "takes/cooking_1/frame_aligned_videos/downscaled/448/cam01.mp4", list(range(47)), fps, size)
    return EgoExo4dSource(tmp_path, settings)


def test_clips_of_enough_labelled_frames_are_kept_and_shorter_ones_are_not(tmp_path):
    labelled = [*range(2, 11), *range(14, 40)]  # 9 frames, then 26
    poses = {str(n): pose(n) for n in labelled} | {
        "11": [],
        "12": [{"annotation2D": {}}],
        "13": pose(13, "cam03"),
    }
    source = egoexo4d(tmp_path, poses)
    assert source.units == ["cooking_1"]
    done = convert(source, tmp_path, "exoego4d")
    assert done.skipped == {"fewer than 10 frames in a row with both hands": 1} and done.spec.hz == 30
    dataset, (episode,) = read_back(done.directory, "observation/image")
    assert [number(image) for image in episode.images] == list(range(14, 39))
    n = np.arange(14, 40)[:, None]
    expected = np.concatenate([30 * n / 3840, 0 * n + 0.25, (1920 + 30 * n) / 3840, 0 * n + 0.5], axis=1)
    np.testing.assert_allclose(episode.actions, expected[1:], atol=1e-6)
    np.testing.assert_allclose(dataset.record(0)["steps/observation/state"].reshape(-1, 4), expected[:-1], atol=1e-6)


def test_what_never_shows_both_hands_is_left_out_and_counted(tmp_path):
    """As takes of which another camera was labelled."""
    for place in (tmp_path / "a", tmp_path / "b"):
        place.mkdir()
    source = egoexo4d(tmp_path / "a", {str(n): pose(n, "cam03") for n in range(40)})
    with pytest.raises(DataError, match="no episode can be made from it: 1 x no frame with both hands"):
        convert(source, tmp_path, "exoego4d")
    with pytest.raises(DataError, match="no episode can be made from it: 1 x no frame with both hands"):
        convert(ego4d(tmp_path / "b", action(annotated(3, ("left_hand",)))), tmp_path, "ego4d")


def test_wrists_outside_the_image_are_not_seen(tmp_path):
    poses = {str(n): pose(n) for n in range(40)}
    poses["20"][0]["annotation2D"]["cam01"]["left_wrist"]["x"] = -3.0
    done = convert(egoexo4d(tmp_path, poses), tmp_path, "exoego4d")
    _, episodes = read_back(done.directory, "observation/image")
    assert [[number(e.images[0]), e.steps] for e in episodes] == [[0, 19], [21, 18]]


def test_the_release_keeps_what_is_too_short_and_we_do_not(tmp_path):
    source = egoexo4d(tmp_path, {str(n): pose(n) for n in range(40)}, settings=EgoExo4dSettings())
    with pytest.raises(DataError, match="1 x fewer than 300 frames in a row"):
        convert(source, tmp_path, "exoego4d")


@pytest.mark.parametrize(
    "poses, options, message",
    [
        ({"3": [{}]}, {}, "uid-1.json: frame '3' has no usable annotation2D"),
        ({"x": pose(3)}, {}, "uid-1.json: frame 'x' has no usable annotation2D"),
        ({"3": pose(3), "-1": pose(3)}, {}, "uid-1.json: frame '-1' has no usable annotation2D"),
        ({"3": pose(3), "4" * 9: pose(3)}, {}, "uid-1.json: it has frame 444444444, but .*cam01.mp4 has at most"),
        ({"3": pose(3), "4" * 10: pose(3)}, {}, "uid-1.json: frame '4444444444' has no usable annotation2D"),
        ({"3": pose(3)}, {"fps": 25}, "cam01.mp4: 25 frames per second, not 30"),
        ({"3": pose(3)}, {"size": (64, 64)}, "64 x 64 pixels has another aspect ratio than 3840 x 2160"),
    ],
)
def test_malformed_takes_are_named(tmp_path, poses, options, message):
    with pytest.raises(DataError, match=message):
        convert(egoexo4d(tmp_path, poses, **options), tmp_path, "exoego4d")


@pytest.mark.parametrize("field", ["take_uid", "take_name"])
@pytest.mark.parametrize("value", ["../../elsewhere", "/etc/passwd", "a/b", None])
def test_takes_stay_below_their_root(tmp_path, field, value):
    egoexo4d(tmp_path, {"3": pose(3)})
    takes = json.loads((tmp_path / "takes.json").read_text())
    (tmp_path / "takes.json").write_text(json.dumps([takes[0] | {field: value}]))
    with pytest.raises(DataError, match=f"takes.json: {field} .* is not a file name"):
        EgoExo4dSource(tmp_path)


def test_annotated_videos_stay_below_their_folder(tmp_path):
    ego4d(tmp_path, action(annotated(3)))
    text = (tmp_path / "fho_main.json").read_text().replace(f'"{UID}"', '"../full_scale/0a1b"')
    (tmp_path / "fho_main.json").write_text(text)
    with pytest.raises(DataError, match="fho_main.json: video_uid .* is not a file name"):
        Ego4dSource(tmp_path / "fho_main.json", tmp_path / "full_scale")


@pytest.mark.parametrize("number", [-1, 10**12, "3", True])
def test_annotated_frame_beyond_its_video_is_named(tmp_path, number):
    source = ego4d(tmp_path, action(annotated(3) | {"frame_number": number}))
    with pytest.raises(DataError, match=r"fho_main.json: 0a1b, interval 0 has frame_number"):
        list(source.read(0))


def test_a_root_without_takes_is_refused(tmp_path):
    with pytest.raises(DataError, match="takes.json cannot be read .*Give the root of the dataset"):
        EgoExo4dSource(tmp_path)
    egoexo4d(tmp_path, {})
    with pytest.raises(DataError, match="none of the 2 takes .* has both a video"):
        EgoExo4dSource(tmp_path, EgoExo4dSettings(camera="cam09"))
