"""Actions of other episodes for a frozen window, to be compared with its own.

They are from the same robot, from held-out episodes first and from training episodes if these are too few. Each is an
uninterrupted sequence of one episode, as long as the window's real frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from data_pipelines.sampling.order import hash64, stream_seed
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.slicer import WindowSlicer
from data_pipelines.windows.windows import MIN_TRAIN_FRAMES, WindowSet, train_windows, val_windows

CACHED_EPISODES = 512
"""Episodes whose actions are cached in memory."""


class OtherWindow(NamedTuple):
    """A window of another episode: its split, its position there, and its start in stored frames."""

    split: str
    episode: int
    start: int


class OtherWindows:
    """Chooses windows of other episodes by a hash of the frozen window's name, and reads their actions."""

    def __init__(self, store: TokenStore, slicers: dict[str, WindowSlicer], frames: int, rate: float | None, seed: int):
        self._store, self._slicers, self._frames, self._rate, self._seed = store, slicers, frames, rate, seed
        self._sets: dict[tuple[str, str], tuple[WindowSet, np.ndarray, np.ndarray]] = {}
        self._actions = lru_cache(CACHED_EPISODES)(store.actions)

    def choose(self, name: str, episode: int, start: int, count: int) -> list[OtherWindow]:
        """Up to `count` windows for the held-out window at `start` of `episode` (position in the store).

        One of every other held-out episode comes before a second one of any; if these are too few, training episodes
        follow. A longer list begins with the shorter one.
        """
        own = int(self._store.manifest(name).val.episodes[episode])
        steps = int(self._store.manifest(name).val.steps[episode])
        slicer = self._slicers[name]
        real = int(slicer.max_real(steps - start * slicer.frame_step))
        seed = stream_seed(self._seed, "other actions", name, own, start)
        found: list[OtherWindow] = []
        for split in ("val", "train"):
            if len(found) < count:
                found += self._of(name, split, real, seed, episode if split == "val" else -1, count - len(found))
        return found

    def actions(self, name: str, others: Sequence[OtherWindow], width: int) -> np.ndarray:
        """float32 [n, T, U = width]: the chunks of each, as `WindowSlicer.chunks` cuts them."""
        slicer = self._slicers[name]
        chunks = [slicer.chunks(self._actions(name, o.split, o.episode), o.start, width) for o in others]
        return np.stack(chunks) if chunks else np.zeros((0, self._frames, width), np.float32)

    def _of(self, name: str, split: str, real: int, seed: int, own: int, count: int) -> list[OtherWindow]:
        """The first `count` windows of at least `real` frames that are not of episode `own`, in the order of choice."""
        windows, episode_idx, real_of = self._windows(name, split)
        at = np.flatnonzero((real_of >= real) & (episode_idx != own))
        h, found = hash64(at, stream_seed(seed, split)), np.zeros(0, np.int64)  # no two have the same hash
        while len(found) < count and len(at):
            begins = np.flatnonzero(np.diff(episode_idx[at], prepend=-1))
            smallest = np.minimum.reduceat(h, begins)  # of each episode that has one left; only these are sorted
            first = h == np.repeat(smallest, np.diff(begins, append=len(at)))
            found = np.append(found, at[first][np.argsort(smallest)])
            at, h = at[~first], h[~first]
        return [OtherWindow(split, *windows.locate(int(i))) for i in found[:count]]

    def _windows(self, name: str, split: str) -> tuple[WindowSet, np.ndarray, np.ndarray]:
        """The windows of a split, and of each its episode and its real frames."""
        if (name, split) not in self._sets:
            if split == "val":
                found = val_windows(
                    self._store, name, self._frames, min(MIN_TRAIN_FRAMES, self._frames), rate=self._rate
                )
            else:
                found = train_windows(self._store, name, self._frames, rate=self._rate)
            episode_idx = found.episode_idx
            steps = np.asarray(self._store.manifest(name).split(split).steps, np.int64)[episode_idx]
            real = found.slicer.max_real(steps - found.start.astype(np.int64) * found.slicer.frame_step)
            self._sets[name, split] = found, episode_idx, np.asarray(real)
        return self._sets[name, split]
