"""Slicing of a window out of an episode: frames at the study's rate, each with its chunk of actions.

A window that starts at native frame n has frames n, n + stride, ..., each with the native actions from
that frame until the next one, all of them inside one episode. Frames after the last one with a complete chunk are
padding: zeros at the end, which real frames do not attend to and which no metric counts. The other frames are real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import require


@dataclass(frozen=True)
class WindowSlicer:
    """Slices the windows of one dataset. A `start` is in stored frames: native frame start x frame_step."""

    frames: int  # T
    stride: int  # native frames per model frame
    frame_step: int  # native frames per stored frame

    @property
    def native_frames(self) -> int:
        """Native frames of a whole window."""
        return self.frames * self.stride

    @property
    def spacing(self) -> int:
        """Stored frames per model frame."""
        return self.stride // self.frame_step

    def max_real(self, steps: np.ndarray | int) -> np.ndarray | int:
        """The largest number of real frames, at most T, of a window in episodes of `steps` native frames."""
        return np.minimum(steps // self.stride, self.frames)

    def count(self, steps: np.ndarray, min_real: int) -> np.ndarray:
        """int64 per episode: the number of windows, each of as many real frames as the episode allows; 0 if these are
        fewer than `min_real`.

        DIFFERS: the release's windows start at every native frame, which counts for the mixture: at equal length a
        dataset of 30 Hz has 15 times as many as one of 2 Hz. Here that takes a store of every native frame (frame_step
        1); one of the study's rate has about as many of both.
        """
        steps = np.asarray(steps, np.int64)
        real = self.max_real(steps)
        return np.where(real >= min_real, (steps - real * self.stride) // self.frame_step + 1, 0)

    def count_real(self, item: StoredEpisode, start: int) -> int:
        """The number of real frames of the window at `start`."""
        return int(self.max_real(len(item.actions) - start * self.frame_step))

    def real_mask(self, item: StoredEpisode, start: int) -> np.ndarray:
        """bool [T]: which frames are real."""
        return np.arange(self.frames) < self.count_real(item, start)

    def slice_frames(self, array: np.ndarray, item: StoredEpisode, start: int) -> np.ndarray:
        """[T, ...]: the window's entries of an array of `item` that has one per stored frame."""
        real, step = self.count_real(item, start), self.spacing
        return _padded(array[start : start + real * step : step], self.frames)

    def tokens(self, item: StoredEpisode, start: int) -> np.ndarray:
        """The window's tokens: ids, int32 [T, S], or latents, float32 [T, S, C]."""
        dtype = np.float32 if item.tokens.dtype.kind == "f" else np.int32
        return self.slice_frames(item.tokens, item, start).astype(dtype)

    def chunks(self, actions: np.ndarray, start: int, width: int) -> np.ndarray:
        """float32 [T, U = width]: the chunk of each frame, cut from the native actions [N, A] of an episode:
        sub-step-major, raw units, followed by zeros."""
        first = start * self.frame_step
        real = int(self.max_real(len(actions) - first))
        chunk = actions[first : first + real * self.stride].reshape(real, self.stride * actions.shape[1])
        padded = np.zeros((self.frames, width), np.float32)
        padded[:real, : chunk.shape[1]] = chunk
        return padded


def make_slicer(store: TokenStore, name: str, frames: int, rate: float | None) -> WindowSlicer:
    """The slicer at `rate` Hz (None: native). Raises ConfigError if the store lacks frames at that rate."""
    require(frames >= 1, f"frames must be at least 1, got {frames}")
    manifest = store.manifest(name)
    return WindowSlicer(frames, manifest.stride_at(rate), manifest.frame_step)


def _padded(array: np.ndarray, frames: int) -> np.ndarray:
    """[n, ...] -> [frames, ...], zeros at the end; the array itself if nothing is missing."""
    missing = frames - len(array)
    return np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1)) if missing else array
