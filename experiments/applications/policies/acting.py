"""Base class of policies that see the last frames and predict chunks of actions, with their state for B episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np

from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.network import Params, as_floats, downsample_uint8, require_images
from experiments.applications.policies.policy import Counts
from hma_jax.config import require
from hma_jax.simulator.interface import WholeNumbers

STILL = 1e-4
"""A dimension with a smaller standard deviation in the demonstrations counts as constant."""


@dataclass(frozen=True)
class Scale:
    """Raw actions to normalised ones and back."""

    mean: tuple[float, ...]  # [A]
    std: tuple[float, ...]
    low: tuple[float, ...]  # the least value that was demonstrated
    high: tuple[float, ...]

    def __post_init__(self):
        lengths = {name: len(values) for name, values in vars(self).items()}
        require(len(set(lengths.values())) == 1, f"a scale has a value for each dimension of an action, got {lengths}")

    def normalise(self, actions: np.ndarray) -> np.ndarray:
        return ((actions - np.array(self.mean)) / np.array(self.std)).astype(np.float32)

    def raw(self, values: np.ndarray) -> np.ndarray:
        """Raw actions, limited to the demonstrated range."""
        actions = values * np.array(self.std) + np.array(self.mean)
        return np.clip(actions, self.low, self.high).astype(np.float32)


def scale_of(demos: Demonstrations) -> Scale:
    actions = demos.actions[demos.steps()].astype(np.float64)
    std = np.maximum(actions.std(0), STILL)
    return Scale(*(tuple(x.tolist()) for x in (actions.mean(0), std, actions.min(0), actions.max(0))))


def make_examples(demos: Demonstrations, frames: int, chunk: int, size: int) -> dict[str, np.ndarray]:
    """What a network is trained on: the `images` of all episodes, averaged down to `size`, and for each of the n frames
    that count, its `episode` [n], the frames `seen` by then [n, frames] and the `chunk` [n, chunk * A] of normalised
    actions from there on; the first frame is repeated before the beginning, the last action past the end."""
    episode, frame = demos.steps()
    at = np.minimum(frame[:, None] + np.arange(chunk), demos.lengths[episode][:, None] - 1)
    actions = scale_of(demos).normalise(demos.actions[episode[:, None], at])
    return {
        "images": downsample_uint8(demos.images, size),
        "episode": episode,
        "seen": np.maximum(frame[:, None] - np.arange(frames)[::-1], 0),
        "chunk": actions.reshape(len(episode), -1),
    }


def frames_of(examples: Mapping[str, jax.Array], index: jax.Array) -> jax.Array:
    """[B, frames, H, W, 3] in [-1, 1]: the frames seen in the examples `index` [B]."""
    return as_floats(examples["images"][examples["episode"][index][:, None], examples["seen"][index]])


@dataclass(frozen=True)
class ChunkConfig:
    """A policy that sees the last `frames` and plans `chunk` actions, of which it executes the first `execute`."""

    frames: int = 2
    chunk: int = 1
    execute: int = 1

    def __post_init__(self):
        require(self.frames >= 1, f"a policy must see at least 1 frame, got {self.frames}")
        require(
            1 <= self.execute <= self.chunk,
            f"execute must lie in 1..{self.chunk}, the actions of a chunk, got {self.execute}",
        )


class ChunkPolicy:
    """A policy that acts by a trained network, which plans normalised actions.

    Subclasses implement the network: `plan(frames [n, frames, H, W, 3], seeds, steps)` gives [n, chunk * A].
    """

    kind = ""

    def __init__(self, config: ChunkConfig, params: Params, scale: Scale):
        self.config, self.params, self.scale = config, params, scale
        self._counts = Counts()
        self._seen: np.ndarray | None = None  # [B, frames, H, W, 3]
        self._fresh: np.ndarray | None = None  # bool [B]: the next image is the first
        self._left: list[list[np.ndarray]] = []  # planned but not executed

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
        which = self._counts.reset(episodes, seeds)
        if episodes is None or self._seen is None:
            self._seen = None
            return
        self._fresh[which] = True
        for b in which:
            self._left[b] = []

    def act(self, images: np.ndarray) -> np.ndarray:
        require_images(images, batch=True)
        if self._seen is None or len(self._seen) != len(images):
            self._seen = np.repeat(images[:, None], self.config.frames, 1)
            self._fresh, self._left = np.ones(len(images), bool), [[] for _ in images]
        self._seen = np.concatenate([self._seen[:, 1:], images[:, None]], 1)
        self._seen[self._fresh] = images[self._fresh, None]
        self._fresh[:] = False
        counted = self._counts.next(len(images))
        if not all(self._left):  # one call for all: programs are compiled for one size
            planned = self.plan(self._seen, [s for s, _ in counted], [n for _, n in counted])
            planned = self.scale.raw(planned.reshape(len(images), self.config.chunk, -1))
            for b, left in enumerate(self._left):
                if not left:
                    left.extend(planned[b, : self.config.execute])
        return np.stack([left.pop(0) for left in self._left])

    def plan(self, frames: np.ndarray, seeds: Sequence[int], steps: Sequence[int]) -> np.ndarray:
        raise NotImplementedError
