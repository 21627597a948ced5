from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.windows.windows import (
    count_windows,
    cut_actions,
    cut_frames,
    require_windows,
    train_windows,
    val_windows,
)
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import OneDataset

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
