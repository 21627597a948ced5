"""Windows as index arithmetic over episodes: T frames at 2 Hz, each with its action chunk.

Owns which windows exist and how they are cut from an episode. Reads no record to count them.

A window that starts at native frame n has frames n, n + stride, ..., n + (T-1) stride, and
needs the native actions n ... n + T stride - 1: the chunk of a frame is every action from
that frame until the next one. All of them lie inside one episode.
DIFFERS: the release also accepts windows whose last chunk runs up to stride - 1 actions past
the end of the episode, into the next one, drops the last window of a dataset, and keeps
non-overlapping windows only (reference section 5.6); here every start counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.sampling.splits import smallest_hashes
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.manifest import Manifest
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import require


@dataclass(frozen=True)
class WindowSet:
    """The windows of one split of one dataset.

    Starts count stored frames (native frame = start x frame_step). Held as cumulative counts
    per episode, so memory grows with episodes, not with windows.
    """

    name: str
    split: str
    frames: int  # T
    episodes: np.ndarray  # int32: positions in the store
    ends: np.ndarray  # int64: windows up to and including each episode
    too_short: int  # episodes without a single window
    needed: int  # native frames that a window takes
    longest: int  # native frames of the longest episode

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def locate(self, i: int) -> tuple[int, int]:
        """(episode position in the store, start) of window `i`."""
        at = int(np.searchsorted(self.ends, i, side="right"))
        return int(self.episodes[at]), int(i - (self.ends[at - 1] if at else 0))

    def siblings(self, i: int) -> tuple[int, int]:
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

    def shortage(self) -> str:
        """Why there are no windows, for a message."""
        if not self.longest:
            return f"it has no {self.split} episode"
        return (
            f"{self.frames} frames need {self.needed} native frames, the longest of its "
            f"{self.too_short} {self.split} episodes has {self.longest}"
        )


def require_windows(sets: Mapping[str, WindowSet]) -> None:
    """Raises DataError, with the length that would fit, if not one window is left."""
    if any(len(s) for s in sets.values()):
        return
    fits = {name: s.longest * s.frames // s.needed for name, s in sets.items()}
    name = max(fits, key=fits.__getitem__)
    s = sets[name]
    advice = f"use at most {fits[name]} frames, or datasets with longer episodes"
    if not fits[name]:
        advice = "use datasets with more or longer episodes"
    raise DataError(
        f"no {s.split} episode is long enough for a window. {name}: {s.shortage()} at stride "
        f"{s.needed // s.frames}; {advice}."
    )


def count_windows(steps: np.ndarray, frames: int, stride: int, frame_step: int) -> np.ndarray:
    """int64 per episode of `steps` native frames: how many windows start at a stored frame."""
    return np.maximum((np.asarray(steps, np.int64) - frames * stride) // frame_step + 1, 0)


def train_windows(
    store: TokenStore, name: str, frames: int, max_trajectories: int | None = None, subset_seed: int = 0
) -> WindowSet:
    """Windows of the train split, optionally of `max_trajectories` episodes chosen by hash.

    Subsets with one `subset_seed` are nested: 10 trajectories are among the 100.
    """
    require(
        max_trajectories is None or max_trajectories >= 1,
        f"max_trajectories must be at least 1, got {max_trajectories}",
    )
    return _windows(store.manifest(name), "train", frames, max_trajectories, subset_seed)


def val_windows(store: TokenStore, name: str, frames: int) -> WindowSet:
    """Windows of the held-out split."""
    return _windows(store.manifest(name), "val", frames, None, 0)


def _windows(manifest: Manifest, split: str, frames: int, limit: int | None, seed: int) -> WindowSet:
    require(frames >= 1, f"frames must be at least 1, got {frames}")
    facts, name = manifest.split(split), manifest.spec.name
    source = np.asarray(facts.episodes, np.int64)
    chosen = smallest_hashes(name, source, limit, f"subset/{seed}")
    steps = np.asarray(facts.steps, np.int64)[chosen]
    counts = count_windows(steps, frames, manifest.stride, manifest.frame_step)
    usable = counts > 0
    return WindowSet(
        name=name,
        split=split,
        frames=frames,
        episodes=chosen[usable].astype(np.int32),
        ends=np.cumsum(counts[usable]),
        too_short=int((~usable).sum()),
        needed=frames * manifest.stride,
        longest=int(steps.max()) if len(steps) else 0,
    )


def cut_frames(array: np.ndarray, start: int, frames: int, manifest: Manifest) -> np.ndarray:
    """[T, ...]: the window's entries of a per-stored-frame array."""
    step = manifest.stride // manifest.frame_step
    return array[start : start + frames * step : step]


def cut_tokens(item: StoredEpisode, start: int, frames: int, manifest: Manifest) -> np.ndarray:
    """The window's tokens: ids, int32 [T, S], or latents, float32 [T, S, C]."""
    dtype = np.float32 if manifest.tokenizer.channels else np.int32
    return cut_frames(item.tokens, start, frames, manifest).astype(dtype)


def cut_actions(
    item: StoredEpisode, start: int, frames: int, manifest: Manifest, width: int
) -> np.ndarray:
    """float32 [T, U = width]: the action chunk of each frame, sub-step-major, raw units,
    followed by zeros.
    """
    stride, first = manifest.stride, start * manifest.frame_step
    chunk = item.actions[first : first + frames * stride].reshape(frames, stride * item.actions.shape[1])
    padded = np.zeros((frames, width), np.float32)
    padded[:, : chunk.shape[1]] = chunk
    return padded
