"""EPIC-KITCHENS in the published format: rates, numbering, which hands, and a pickle that must not run."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.errors import DataError
from data_pipelines.sources.human.detections import read_hands
from data_pipelines.sources.human.epic_kitchens import EpicKitchensSource
from data_pipelines.sources.settings import EpicKitchensSettings
from tests.data_pipelines.convert.sources import colour, detections, hand, number, read_back, write_epic

LEFT, RIGHT = 0, 1
SHORT = EpicKitchensSettings(min_frames=3)


def moving(n: int) -> list[bytes]:
    """Both hands at frame n: the left one goes right, the right one down; the order varies."""
    hands = [hand(LEFT, 0.2 + n / 256, 0.5), hand(RIGHT, 0.75, 0.25 + n / 128)]
    return hands if n % 2 else hands[::-1]


def rows(start: int, step: int, count: int) -> np.ndarray:
    n = start + step * np.arange(count)
    return np.stack([0.2 + n / 256, 0 * n + 0.5, 0 * n + 0.75, 0.25 + n / 128], axis=1)


@pytest.mark.parametrize("video, step", [("P01_01", 6), ("P02_101", 5)])
def test_frames_positions_and_displacements_at_10_hz(tmp_path, video, step):
    frames = [moving(n) for n in range(1, 44)]
    source = EpicKitchensSource(*write_epic(tmp_path, video, frames), SHORT)
    done = convert(source, tmp_path, "epic")
    assert done.spec.hz == 10 and done.episodes == 1
    dataset, (episode,) = read_back(done.directory, "observation/image")
    kept = np.arange(1, 44, step)  # frames 1, 1 + step, ...; the last one is a target only
    assert [number(image) for image in episode.images] == kept[:-1].tolist()
    expected = rows(1, step, len(kept))
    np.testing.assert_allclose(episode.actions, np.diff(expected, axis=0), atol=1e-6)
    np.testing.assert_allclose(dataset.record(0)["steps/observation/state"].reshape(-1, 4), expected[:-1], atol=1e-6)
    assert (
        dataset.record(0)["steps/observation/image"][1]
        == (tmp_path / f"EPIC/{video[:3]}/rgb_frames/{video}/frame_{kept[1]:010d}.jpg").read_bytes()
    )  # not encoded a second time


def test_episodes_end_where_a_hand_is_missing_and_nothing_is_joined(tmp_path):
    frames = [moving(n) for n in range(1, 91)]
    frames[36] = [hand(LEFT, 0.2, 0.5)]  # frame 37, a kept one
    frames[39] = []  # frame 40, between kept ones
    frames[78] = [hand(LEFT, 0.2, 0.5), hand(LEFT, 0.8, 0.5)]  # frame 79: two left hands
    source = EpicKitchensSource(*write_epic(tmp_path, "P01_01", frames), SHORT)
    done = convert(source, tmp_path, "epic")
    _, episodes = read_back(done.directory, "observation/image")
    assert [[number(i) for i in e.images] for e in episodes] == [[1, 7, 13, 19, 25], [43, 49, 55, 61, 67]]
    assert done.skipped == {"fewer than 3 frames in a row with both hands": 1}  # 85 alone


def test_the_best_hand_of_each_side_counts_from_the_threshold_on(tmp_path):
    frames = [
        [
            hand(RIGHT, 0.9, 0.9, 0.6),
            hand(RIGHT, 0.6, 0.6, 0.8),
            hand(LEFT, 0.1, 0.2, 0.55),
            hand(LEFT, 0.3, 0.4, 0.5),
        ],
        [hand(LEFT, 0.1, 0.2, 0.49), hand(RIGHT, 0.6, 0.6)],
    ]
    _, folder = write_epic(tmp_path, "P01_01", frames)
    found = read_hands(folder / "P01" / "P01_01.pkl", 0.5)
    np.testing.assert_allclose(found[0], [0.1, 0.2, 0.6, 0.6], atol=1e-6)
    assert np.isnan(found[1]).tolist() == [True, True, False, False]


def test_long_runs_are_cut_into_equal_pieces_without_losing_a_step(tmp_path, monkeypatch):
    monkeypatch.setattr("data_pipelines.sources.human.epic_kitchens.MAX_STEPS", 4)
    frames = [moving(n) for n in range(1, 67)]  # kept: 11, so 10 steps
    done = convert(EpicKitchensSource(*write_epic(tmp_path, "P01_01", frames), SHORT), tmp_path, "epic")
    _, episodes = read_back(done.directory, "observation/image")
    assert [[number(i) for i in e.images] for e in episodes] == [[1, 7, 13], [19, 25, 31, 37], [43, 49, 55]]
    np.testing.assert_allclose(
        np.concatenate([e.actions for e in episodes]), np.diff(rows(1, 6, 11), axis=0), atol=1e-6
    )


def test_a_pickle_that_is_a_program_is_refused_and_not_run(tmp_path):
    ran = tmp_path / "ran"

    class Program:
        def __reduce__(self):
            return Path.touch, (ran,)

    frames, folder = write_epic(tmp_path, "P01_01", [moving(1)])
    path = folder / "P01" / "P01_01.pkl"
    path.write_bytes(pickle.dumps([Program()]))
    with pytest.raises(DataError, match=r"P01_01.pkl: not a pickled list of bytes \(it needs .*it was not run"):
        convert(EpicKitchensSource(frames, folder, SHORT), tmp_path, "epic")
    assert not ran.exists()


@pytest.mark.parametrize(
    "content, message",
    [
        (pickle.dumps({"a": b""}), "something other than a list of bytes"),
        (pickle.dumps([b"", "text"]), "something other than a list of bytes"),
        (b"not a pickle", "not a pickled list of bytes"),
        (pickle.dumps([detections("P01_01", 1, []), b"\xff\xff"]), "record 1 is not a detection message"),
        (
            pickle.dumps([detections("P01_01", 1, []), detections("P01_01", 3, [])]),
            "record 1 is for frame 3, not 2",
        ),
    ],
)
def test_malformed_detections_are_named_to_the_record(tmp_path, content, message):
    frames, folder = write_epic(tmp_path, "P01_01", [moving(1)])
    (folder / "P01" / "P01_01.pkl").write_bytes(content)
    with pytest.raises(DataError, match=message):
        convert(EpicKitchensSource(frames, folder, SHORT), tmp_path, "epic")


def test_frames_that_are_missing_damaged_or_of_another_extraction_are_named(tmp_path):
    frames, folder = write_epic(tmp_path, "P01_01", [moving(n) for n in range(1, 31)])
    frame = frames / "P01/rgb_frames/P01_01/frame_0000000013.jpg"
    whole = frame.read_bytes()
    frame.write_bytes(b"\xff\xd8\xff damaged")
    with pytest.raises(DataError, match="frame_0000000013.jpg: the frame cannot be decoded"):
        convert(EpicKitchensSource(frames, folder, SHORT), tmp_path, "epic")
    frame.unlink()
    with pytest.raises(DataError, match="frame_0000000013.jpg: the frame cannot be read"):
        convert(EpicKitchensSource(frames, folder, SHORT), tmp_path, "epic")
    frame.write_bytes(whole)
    frame.with_name("frame_0000000031.jpg").write_bytes(whole)
    with pytest.raises(DataError, match="ends with frame 30: frames and detections are from different extractions"):
        convert(EpicKitchensSource(frames, folder, SHORT), tmp_path, "epic")


def test_videos_without_detections_are_no_units(tmp_path):
    frames, folder = write_epic(tmp_path, "P01_01", [moving(1)])
    (frames / "P01/rgb_frames/P01_02").mkdir()
    assert EpicKitchensSource(frames, folder).units == ["P01_01"]
    with pytest.raises(DataError, match="no video with frames and detections .*--detections"):
        EpicKitchensSource(frames, tmp_path)
    assert colour(0)[0] < colour(0)[2]  # BGR would not pass `number`
