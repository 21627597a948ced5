from __future__ import annotations

import json
import re

import numpy as np
import pytest

from data_pipelines.episode_record import StoredEpisode
from data_pipelines.errors import DataError
from data_pipelines.tokenize_job import _Moments
from data_pipelines.windows import (
    count_windows,
    cut_actions,
    cut_frames,
    require_windows,
    train_windows,
    val_windows,
)
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import GOLDEN, OneDataset


# --- which windows exist ----------------------------------------------------------------------


@pytest.mark.parametrize("stride, frame_step", [(1, 1), (2, 2), (2, 1), (5, 5), (5, 1), (6, 3)])
@pytest.mark.parametrize("frames", [1, 4, 12])
def test_windows_are_all_those_that_lie_inside_one_episode(stride, frame_step, frames):
    steps = [1, 3, 11, 12, 13, 24, 25, 59, 60, 61, 62, 83]
    found = train_windows(OneDataset(steps, hz=2 * stride, frame_step=frame_step), "toy", frames)
    expected = [
        (e, native // frame_step)
        for e, n in enumerate(steps)
        for native in range(0, n, frame_step)
        if native + frames * stride <= n  # the chunk of the last frame is whole
    ]
    assert list(zip(found.episode_idx.tolist(), found.start.tolist(), strict=True)) == expected
    assert [found.locate(i) for i in range(len(found))] == expected
    assert found.too_short == sum(n < frames * stride for n in steps)
    assert len(found) == count_windows(np.array(steps), frames, stride, frame_step).sum()


def test_frames_and_actions_of_a_window_belong_together():
    """Chunk k holds the native actions from frame k until frame k + 1."""
    stride, frame_step, frames = 6, 3, 4
    data = OneDataset([40], hz=2 * stride, frame_step=frame_step, dims=(2,))
    stored = np.arange(0, 40, frame_step)
    item = StoredEpisode(0, None, stored[:, None], np.arange(40)[:, None] + np.array([0.0, 0.5]), None)
    windows = train_windows(data, "toy", frames)
    for i in range(len(windows)):
        _, start = windows.locate(i)
        native = cut_frames(item.tokens, start, frames, data.manifest("toy"))[:, 0]
        assert native.tolist() == [start * 3 + 6 * k for k in range(4)]
        chunks = cut_actions(item, start, frames, data.manifest("toy"), width=15)
        assert chunks.shape == (4, 15) and (chunks[:, 12:] == 0).all()
        assert (chunks[:, 0:12:2] == native[:, None] + np.arange(6)).all()
        assert (chunks[:, 1:12:2] == native[:, None] + np.arange(6) + 0.5).all()


def test_subsets_of_trajectories_are_nested():
    data = OneDataset([20] * 300)
    previous: set[int] = set()
    for limit in (1, 10, 100):
        chosen = set(train_windows(data, "toy", 4, limit).episodes.tolist())
        assert len(chosen) == limit and previous <= chosen
        previous = chosen
    assert len(set(train_windows(data, "toy", 4, 10**6).episodes)) == 300
    other = set(train_windows(data, "toy", 4, 100, subset_seed=1).episodes.tolist())
    assert other != previous
    with pytest.raises(ConfigError, match="max_trajectories must be at least 1"):
        train_windows(data, "toy", 4, 0)


def test_too_short_episodes_count_as_trajectories_but_give_no_windows():
    windows = train_windows(OneDataset([4, 30, 4, 4]), "toy", 5)
    assert windows.too_short == 3 and set(windows.episodes.tolist()) == {1}


def test_nothing_long_enough_says_what_would_fit():
    data = OneDataset([10, 15], hz=4)
    windows = train_windows(data, "toy", 12)
    assert len(windows) == 0
    with pytest.raises(DataError, match="12 frames need 24 .* longest of its 2 .* has 15.*at most 7"):
        require_windows({"toy": windows})
    assert len(train_windows(data, "toy", 7)) > 0
    assert len(train_windows(data, "toy", 8)) == 0


def test_a_dataset_without_episodes_is_not_a_crash():
    with pytest.raises(DataError, match="toy: it has no val episode.*more or longer episodes"):
        require_windows({"toy": val_windows(OneDataset([10]), "toy", 4)})


def test_memory_does_not_grow_with_windows():
    windows = train_windows(OneDataset([10**6] * 3), "toy", 12)
    assert len(windows) == 3 * (10**6 - 11)
    assert windows.ends.nbytes + windows.episodes.nbytes < 100
    assert windows.locate(len(windows) - 1) == (2, 10**6 - 12)


# --- against the official release ---------------------------------------------------------------


@pytest.fixture(scope="module")
def official():
    root = GOLDEN / "15_windows"
    segments = np.fromfile(root / "segment_ids.bin", np.int32)
    tokens = np.fromfile(root / "video.bin", np.uint32).reshape(len(segments), 16)
    actions = np.fromfile(root / "actions.bin", np.float32).reshape(len(segments), 3)
    facts = json.loads((root / "windows.json").read_text())
    return segments, tokens, actions, facts, np.load(root / "items.npz")


def test_starts_equal_the_official_ones_but_for_the_two_stated_differences(official):
    segments, _, _, facts, _ = official
    ends = np.flatnonzero(np.diff(segments, append=-1)) + 1
    firsts = np.concatenate([[0], ends[:-1]])
    checked = 0
    for case in facts["window_lists"]:
        if not case["filter_interrupts"] or case["filter_overlaps"]:
            continue  # windows over an episode's end; DIFFERS: overlapping windows are kept
        frames, stride = case["window"], case["stride"]
        ours = train_windows(OneDataset((ends - firsts).tolist(), hz=2 * stride), "toy", frames)
        starts = set((firsts[ours.episode_idx] + ours.start).tolist())
        theirs = set(case["starts"])
        # DIFFERS: theirs lets the last chunk run over the end of the episode ...
        over = {s for s in theirs if s + frames * stride > ends[segments[s]]}
        # ... and drops the very last window of the dataset.
        last = {len(segments) - frames * stride}
        assert starts == (theirs - over) | last
        assert bool(over) == (stride > 1)
        checked += 1
    assert checked == 3


def test_items_equal_the_official_ones(official):
    segments, tokens, actions, _, items = official
    checked = 0
    for key in items:
        if not key.endswith("input_ids"):
            continue
        name = key.removesuffix("__input_ids")
        frames, stride, start = map(int, re.findall(r"\d+", name))
        episode = np.flatnonzero(segments == segments[start])
        if start + frames * stride > episode[-1] + 1:
            continue
        data = OneDataset([len(episode)], hz=2 * stride)
        item = StoredEpisode(0, None, tokens[episode], actions[episode], None)
        first = start - episode[0]
        ours = cut_frames(item.tokens, first, frames, data.manifest("toy"))
        assert np.array_equal(ours.ravel(), items[key])
        chunks = cut_actions(item, first, frames, data.manifest("toy"), width=3 * stride)
        assert np.array_equal(chunks, items[f"{name}__action_ids"])
        checked += 1
    assert checked >= 5


def test_action_statistics_equal_the_official_ones(official):
    segments, _, actions, facts, _ = official
    moments = _Moments(3)
    for episode in range(segments[-1] + 1):
        moments.add(actions[segments == episode])
    mean, std = moments.result()
    np.testing.assert_allclose(mean, facts["action_mean"], atol=1e-5)
    np.testing.assert_allclose(std, facts["action_std"], atol=1e-5)
