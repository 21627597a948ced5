"""How a window is cut from an episode: frames at the study's rate, each with its chunk of actions.

A window that starts at native frame n has frames n, n + stride, ..., each with the native actions from
that frame until the next one, all of them inside one episode. Frames past the last one whose chunk is whole
are padding: zeros, which no real frame may see and no number may count. Padding stands at the end only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import require


@dataclass(frozen=True)
class Cut:
    """Of the windows of one dataset. Starts count stored frames (native frame = start x frame_step)."""

    frames: int  # T
    stride: int  # native frames per model frame
    frame_step: int  # native frames per stored frame

    @property
    def native(self) -> int:
        """Native frames of a whole window."""
        return self.frames * self.stride

    @property
    def spacing(self) -> int:
        """Stored frames per model frame."""
        return self.stride // self.frame_step

    def longest(self, steps: np.ndarray | int) -> np.ndarray | int:
        """The most real frames, at most T, that a window of episodes of `steps` native frames has."""
        return np.minimum(steps // self.stride, self.frames)

    def count(self, steps: np.ndarray, least: int) -> np.ndarray:
        """int64 per episode: windows that start at a stored frame and have as many real frames as the episode
        allows; none where that is less than `least`."""
        steps = np.asarray(steps, np.int64)
        real = self.longest(steps)
        return np.where(real >= least, (steps - real * self.stride) // self.frame_step + 1, 0)

    def real(self, item: StoredEpisode, start: int) -> int:
        """Real frames of the window at `start`."""
        return int(self.longest(len(item.actions) - start * self.frame_step))

    def valid(self, item: StoredEpisode, start: int) -> np.ndarray:
        """bool [T]: which frames are real."""
        return np.arange(self.frames) < self.real(item, start)

    def of_frames(self, array: np.ndarray, item: StoredEpisode, start: int) -> np.ndarray:
        """[T, ...]: the window's entries of a per-stored-frame array of `item`."""
        real, step = self.real(item, start), self.spacing
        return _padded(array[start : start + real * step : step], self.frames)

    def tokens(self, item: StoredEpisode, start: int) -> np.ndarray:
        """The window's tokens: ids, int32 [T, S], or latents, float32 [T, S, C]."""
        dtype = np.float32 if item.tokens.dtype.kind == "f" else np.int32
        return self.of_frames(item.tokens, item, start).astype(dtype)

    def actions(self, item: StoredEpisode, start: int, width: int) -> np.ndarray:
        """float32 [T, U = width]: the action chunk of each frame, sub-step-major, raw units,
        followed by zeros."""
        return self.chunks(item.actions, start, width)

    def chunks(self, actions: np.ndarray, start: int, width: int) -> np.ndarray:
        """The same of the native actions of an episode [N, A], without anything else of it."""
        first = start * self.frame_step
        real = int(self.longest(len(actions) - first))
        chunk = actions[first : first + real * self.stride].reshape(real, self.stride * actions.shape[1])
        padded = np.zeros((self.frames, width), np.float32)
        padded[:real, : chunk.shape[1]] = chunk
        return padded


def make_cut(store: TokenStore, name: str, frames: int, rate: float | None) -> Cut:
    """At `rate` Hz (None: native). Raises ConfigError if the store lacks frames of that rate."""
    require(frames >= 1, f"frames must be at least 1, got {frames}")
    manifest = store.manifest(name)
    return Cut(frames, manifest.stride_at(rate), manifest.frame_step)


def _padded(array: np.ndarray, frames: int) -> np.ndarray:
    """[n, ...] -> [frames, ...], zeros at the end; as it is where nothing is missing."""
    missing = frames - len(array)
    return np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1)) if missing else array
