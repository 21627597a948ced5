from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.loading.selection import LoaderConfig, select_windows
from data_pipelines.sampling.mixture import mixture_weights
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.windows.slicer import WindowSlicer
from data_pipelines.windows.windows import require_windows, train_windows, val_windows
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import OneDataset

# --- which windows exist ----------------------------------------------------------------------


@pytest.mark.parametrize("stride, frame_step", [(1, 1), (2, 2), (2, 1), (5, 5), (5, 1), (6, 3)])
@pytest.mark.parametrize("frames", [1, 4, 12])
@pytest.mark.parametrize("least", [2, 12])
def test_windows_are_the_longest_that_lie_inside_one_episode(stride, frame_step, frames, least):
    steps = [1, 3, 11, 12, 13, 24, 25, 59, 60, 61, 62, 83]
    found = train_windows(
        OneDataset(steps, hz=2 * stride, frame_step=frame_step), "toy", frames, min_real=least, rate=2.0
    )
    # The chunk of the last real frame is whole; T are enough.
    real = [min(n // stride, frames) for n in steps]
    least = min(least, frames)
    expected = [
        (e, native // frame_step)
        for e, n in enumerate(steps)
        for native in range(0, n, frame_step)
        if real[e] >= least and native + real[e] * stride <= n
    ]
    assert list(zip(found.episode_idx.tolist(), found.start.tolist(), strict=True)) == expected
    assert [found.locate(i) for i in range(len(found))] == expected
    assert found.too_short == sum(r < least for r in real)
    assert found.padded == sum(least <= r < frames for r in real)


def test_shares_of_the_mixture_are_the_release_s_if_every_native_frame_is_stored():
    """Three robots with equally long recordings, at 2, 10 and 30 Hz. Of the frames of each remainder modulo the stride
    the release makes windows that do not overlap (reference section 5.6)."""
    seconds, strides = [300, 450, 600], np.array([1, 5, 15])
    released = [sum(len(range(r, 2 * s * n, s)) // 12 for n in seconds for r in range(s)) for s in strides]

    def shares(steps_of) -> np.ndarray:
        stores = [OneDataset([2 * s * n for n in seconds], hz=2 * s, frame_step=steps_of(s)) for s in strides]
        return mixture_weights([len(train_windows(store, "toy", 12, rate=2.0)) for store in stores], 3.0)

    np.testing.assert_allclose(shares(lambda _: 1), mixture_weights(released, 3.0), rtol=0.01)
    np.testing.assert_allclose(shares(lambda stride: stride), 1 / 3)


def item_of(steps: int, frame_step: int) -> StoredEpisode:
    """Tokens and actions say which native frame they are of; values of an action are 0.5 apart."""
    stored = np.arange(1, steps + 1, frame_step)
    return StoredEpisode(0, None, stored[:, None], np.arange(1, steps + 1)[:, None] + np.array([0.0, 0.5]), None)


@pytest.mark.parametrize("steps, real", [(40, 4), (23, 3), (12, 2)])
def test_frames_and_actions_of_a_window_belong_together(steps, real):
    """Chunk k holds the native actions from frame k until frame k + 1; what is missing is zero."""
    data, item = OneDataset([steps], hz=12, frame_step=3, dims=(2,)), item_of(steps, 3)
    windows = train_windows(data, "toy", 4, rate=2.0)
    assert len(windows) > 0
    for i in range(len(windows)):
        _, start = windows.locate(i)
        assert windows.slicer.real_mask(item, start).tolist() == [t < real for t in range(4)]
        native = windows.slicer.tokens(item, start)[:, 0]
        assert native.tolist() == [start * 3 + 6 * k + 1 if k < real else 0 for k in range(4)]
        chunks = windows.slicer.chunks(item.actions, start, width=15)
        assert chunks.shape == (4, 15) and (chunks[:, 12:] == 0).all() and (chunks[real:] == 0).all()
        assert (chunks[:real, 0:12:2] == native[:real, None] + np.arange(6)).all()
        assert (chunks[:real, 1:12:2] == native[:real, None] + np.arange(6) + 0.5).all()


def test_language_table_gives_windows():
    """Its 442,226 episodes have 15.9 steps on average at 10 Hz, where twelve whole frames take 60: lengths as
    in its published statistics, roughly."""
    steps = np.random.default_rng(0).poisson(15.9, 2000).tolist()
    windows = train_windows(OneDataset(steps, hz=10, frame_step=5), "toy", 12, rate=2.0)
    assert len(windows) > 1800 and windows.padded == len(windows)
    assert len(train_windows(OneDataset(steps, hz=10, frame_step=5), "toy", 12, min_real=12, rate=2.0)) == 0


@pytest.mark.parametrize("rate, stride", [(2.0, 5), (None, 1), (5.0, 2), (3.0, 3), (10.0, 1), (30.0, 1)])
def test_the_rate_decides_the_stride(rate, stride):
    windows = train_windows(OneDataset([60], hz=10), "toy", 4, rate=rate)
    assert windows.slicer == WindowSlicer(frames=4, stride=stride, frame_step=1)
    assert len(windows) == 60 - 4 * stride + 1


def test_frames_that_are_not_stored_name_the_command_that_stores_them():
    with pytest.raises(ConfigError, match="toy: 5 Hz needs every 2nd .* keeps every 5th.*hma tokenize .*frame_step=1"):
        train_windows(OneDataset([60], hz=10, frame_step=5), "toy", 4, rate=5.0)
    with pytest.raises(ConfigError, match="the native rate needs every 1st"):
        train_windows(OneDataset([60], hz=10, frame_step=5), "toy", 4, rate=None)


def test_subsets_of_trajectories_are_nested():
    data = OneDataset([20] * 300)
    previous: set[int] = set()
    for limit in (1, 10, 100):
        chosen = set(train_windows(data, "toy", 4, limit, rate=2.0).episodes.tolist())
        assert len(chosen) == limit and previous <= chosen
        previous = chosen
    assert len(set(train_windows(data, "toy", 4, 10**6, rate=2.0).episodes)) == 300
    other = set(train_windows(data, "toy", 4, 100, subset_seed=1, rate=2.0).episodes.tolist())
    assert other != previous
    with pytest.raises(ConfigError, match="max_trajectories must be at least 1"):
        train_windows(data, "toy", 4, 0, rate=2.0)


@pytest.mark.parametrize("runs", [(), (EpisodeRun("toy.tfrecord", 0, 200),)], ids=["numbers", "names"])
def test_too_short_episodes_use_up_no_trajectories(runs):
    """Four in five are too short here: ten trajectories are ten that can be trained on."""
    data = OneDataset([1, 30, 1, 1, 1] * 40)
    settings = replace(data.manifest("toy").settings, val_fraction=0.0, min_val=0)
    data._manifest = replace(data.manifest("toy"), runs=runs, settings=settings)
    windows = train_windows(data, "toy", 5, max_trajectories=10, rate=2.0)
    assert windows.too_short == 160 and len(windows.episodes) == 10 and (windows.episodes % 5 == 1).all()


def test_trajectories_of_a_subset_are_counted_without_the_damaged_ones():
    data = OneDataset([20] * 20)  # of 200, of which 180 were skipped
    settings = replace(data.manifest("toy").settings, val_fraction=0.0, min_val=0)
    data._manifest = replace(data.manifest("toy"), runs=(EpisodeRun("toy.tfrecord", 0, 200),), settings=settings)
    for cap in (None, 1, 40, 150):
        used = train_windows(data, "toy", 4, cap, rate=2.0).episodes
        assert len(used) == 20 if cap is None else len(used) < min(cap + 1, 20)
        if len(used):
            chosen = select_windows(data, LoaderConfig(4, max_trajectories=cap, datasets=("toy",)))
            assert chosen.drawn()["toy"].trajectories == len(used)


def test_nothing_long_enough_says_what_is_needed():
    windows = train_windows(OneDataset([2, 3], hz=4), "toy", 12, rate=2.0)
    assert len(windows) == 0
    with pytest.raises(
        DataError, match="at least 2 frames, which at stride 2 need 4 .*; the longest of its 2 .* has 3"
    ):
        require_windows({"toy": windows})
    assert len(train_windows(OneDataset([2, 4], hz=4), "toy", 12, rate=2.0)) == 1


@pytest.mark.parametrize(
    "hz, min_real, advice",
    [
        (4, 5, "Set a higher frame rate (--set rate=HZ) or a shorter prompt (--set eval.prompt_frames=N), or add"),
        (4, 2, "Set a higher frame rate (--set rate=HZ), or add datasets with more or longer episodes."),
        (2, 5, "Set a shorter prompt (--set eval.prompt_frames=N), or add datasets"),
        (2, 2, "Add datasets with more or longer episodes."),
    ],
)
def test_nothing_long_enough_names_the_settings_that_would_help(hz, min_real, advice):
    """At stride 1 every frame is taken already, and training needs no prompt."""
    windows = train_windows(OneDataset([1, 1], hz=hz), "toy", 12, min_real=min_real, rate=2.0)
    with pytest.raises(DataError, match=re.escape(f". {advice}")):
        require_windows({"toy": windows})


def test_a_dataset_without_episodes_is_not_a_crash():
    said = (
        "no val episode for windows.* toy: it has no val episode. Of a single .* add more. .* store.min_val and store"
    )
    with pytest.raises(DataError, match=said):
        require_windows({"toy": val_windows(OneDataset([10]), "toy", 4, 2, rate=2.0)})


def test_memory_does_not_grow_with_windows():
    windows = train_windows(OneDataset([10**6] * 3), "toy", 12, rate=2.0)
    assert len(windows) == 3 * (10**6 - 11)
    assert windows.ends.nbytes + windows.episodes.nbytes < 100
    assert windows.locate(len(windows) - 1) == (2, 10**6 - 12)
