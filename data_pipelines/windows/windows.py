"""Windows as index arithmetic over episodes: T frames at the study's rate, each with its action chunk.

Owns which windows exist; `slicer` slices one out of an episode. No record is read to count them.

In an episode that is long enough, every start whose T frames all have whole chunks is a window. A shorter episode gives
padded windows with all of its real frames: at least `MIN_TRAIN_FRAMES` for training; for evaluation the prompt and one
more, or all T if a policy's prompt fills the window.
DIFFERS: the release has no padded windows, accepts windows whose last chunk runs up to stride - 1 actions past the end
of the episode, into the next one, drops the last window of a dataset, and keeps non-overlapping windows only (reference
section 5.6).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.sampling.splits import smallest_hashes, subset, subset_salt, used_episodes
from data_pipelines.sources.identity import episode_ids
from data_pipelines.tokens.manifest import Manifest
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.slicer import WindowSlicer, make_slicer
from hma_jax.config import require

MIN_TRAIN_FRAMES = 2
"""Real frames of a training window: one to see and one to predict."""


@dataclass(frozen=True)
class WindowSet:
    """The windows of one split of one dataset.

    Held as cumulative counts per episode, so memory grows with episodes, not with windows.
    """

    name: str
    split: str
    slicer: WindowSlicer
    min_real: int  # least number of real frames of a window
    episodes: np.ndarray  # int32: positions in the store
    ends: np.ndarray  # int64: windows up to and including each episode
    padded: int  # episodes whose windows are padded
    too_short: int  # episodes without a single window
    longest_episode: int  # native frames of the longest episode

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    @property
    def needed(self) -> int:
        """Native frames of the shortest window that is allowed."""
        return self.min_real * self.slicer.stride

    def locate(self, i: int) -> tuple[int, int]:
        """(episode position in the store, start) of window `i`."""
        at = int(np.searchsorted(self.ends, i, side="right"))
        return int(self.episodes[at]), int(i - (self.ends[at - 1] if at else 0))

    def episode_range(self, i: int) -> tuple[int, int]:
        """The range [first, end) of all windows of window `i`'s episode."""
        at = int(np.searchsorted(self.ends, i, side="right"))
        return int(self.ends[at - 1]) if at else 0, int(self.ends[at])

    @property
    def counts(self) -> np.ndarray:
        """int64: windows of each episode."""
        return np.diff(self.ends, prepend=0)

    @property
    def episode_idx(self) -> np.ndarray:
        """int32 [windows]: the episode of each window."""
        return np.repeat(self.episodes, self.counts).astype(np.int32)

    @property
    def start(self) -> np.ndarray:
        """int32 [windows]: the start of each window, in stored frames."""
        return (np.arange(len(self)) - np.repeat(self.ends - self.counts, self.counts)).astype(np.int32)

    def why_empty(self) -> str:
        """Why there are no windows, for a message."""
        if not self.longest_episode:
            return f"it has no {self.split} episode"
        if self.longest_episode >= self.needed:
            return "all trajectories that were drawn from it were skipped: raise max_trajectories"
        return (
            f"a window has at least {self.min_real} frames, which at stride {self.slicer.stride} need {self.needed} "
            f"native frames; the longest of its {self.too_short} {self.split} episodes has {self.longest_episode}"
        )


def least_judged(prompt: int, frames: int) -> int:
    """Least number of real frames of a window for evaluation: the prompt and one more, or all T if a policy's prompt
    fills it."""
    return min(prompt + 1, frames)


def settings_for_short(stride: int, min_real: int) -> str:
    """In words, the settings with which episodes too short for `min_real` frames at `stride` may give windows; '' if
    there are none."""
    rate = ["a higher frame rate (--set rate=HZ)"] * (stride > 1)
    return " or ".join(rate + ["a shorter prompt (--set eval.prompt_frames=N)"] * (min_real > MIN_TRAIN_FRAMES))


def require_windows(sets: Mapping[str, WindowSet]) -> None:
    """Raises DataError, saying what would help, if not one window is left."""
    if any(len(s) for s in sets.values()):
        return
    split = next(iter(sets.values())).split
    reasons = "; ".join(f"{name}: {s.why_empty()}" for name, s in sets.items())
    if not any(s.longest_episode for s in sets.values()):
        raise DataError(
            f"there is no {split} episode for windows. {reasons}. Of a single episode none can be held out: add more. "
            "With several, store.val_fraction, store.min_val and store.max_val set how many are held out."
        )
    settings = settings_for_short(max(s.slicer.stride for s in sets.values()), max(s.min_real for s in sets.values()))
    add = f"Set {settings}, or add" if settings else "Add"
    raise DataError(
        f"no {split} episode is long enough for a window. {reasons}. {add} datasets with more or longer episodes."
    )


def train_windows(
    store: TokenStore,
    name: str,
    frames: int,
    max_trajectories: int | None = None,
    subset_seed: int = 0,
    *,
    rate: float | None,
    min_real: int = MIN_TRAIN_FRAMES,
) -> WindowSet:
    """Windows of the train split, optionally of `max_trajectories` episodes chosen by hash.

    Windows have at least `min_real` real frames, or all T if the model's T is smaller.

    Subsets with the same `subset_seed` are nested: 10 trajectories are among the 100. Episodes without a window are not
    drawn.
    """
    require(
        max_trajectories is None or max_trajectories >= 1,
        f"max_trajectories must be at least 1, got {max_trajectories}",
    )
    slicer = make_slicer(store, name, frames, rate)
    return _windows(store, name, "train", slicer, min(min_real, frames), max_trajectories, subset_seed)


def val_windows(store: TokenStore, name: str, frames: int, min_real: int, *, rate: float | None) -> WindowSet:
    """Windows of the held-out split with at least `min_real` real frames."""
    return _windows(store, name, "val", make_slicer(store, name, frames, rate), min_real, None, 0)


def _windows(
    store: TokenStore, name: str, split: str, slicer: WindowSlicer, min_real: int, limit: int | None, seed: int
) -> WindowSet:
    require(
        1 <= min_real <= slicer.frames,
        f"windows of {slicer.frames} frames cannot have at least {min_real} recorded ones",
    )
    manifest = store.manifest(name)
    steps = np.asarray(manifest.split(split).steps, np.int64)
    counts = slicer.count(steps, min_real)
    usable = np.flatnonzero(counts)
    chosen = usable if limit is None else _chosen(manifest, split, counts > 0, limit, subset_salt(seed))
    return WindowSet(
        name=name,
        split=split,
        slicer=slicer,
        min_real=min_real,
        episodes=chosen.astype(np.int32),
        ends=np.cumsum(counts[chosen]),
        padded=int((steps[chosen] < slicer.native_frames).sum()),
        too_short=len(steps) - len(usable),
        longest_episode=int(steps.max()) if len(steps) else 0,
    )


def _chosen(manifest: Manifest, split: str, usable: np.ndarray, limit: int, salt: str) -> np.ndarray:
    """Positions in the store's split, ascending, of those `usable` (bool) episodes that are among the `limit` drawn.

    They are drawn from the usable and the skipped ones, whose length is unknown: a skipped one is not replaced.
    """
    name, present = manifest.spec.name, np.asarray(manifest.split(split).episodes, np.int64)
    at = np.flatnonzero(usable)
    if not manifest.runs:  # a store that names episodes by their number
        return at[smallest_hashes(name, present[at], limit, salt)]
    ids = episode_ids(manifest.runs)
    train, val = used_episodes(manifest.spec, manifest.runs, manifest.settings.held_out)
    members = val if split == "val" else train
    members[present[~usable]] = False
    return at[subset(name, ids, members, present[at], limit, salt)]
