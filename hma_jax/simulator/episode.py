"""The host's record of a simulated episode: enough to rewind it."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np

from hma_jax.generation.episodes import Episodes
from hma_jax.simulator.interface import read_only, require_actions_between
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start


@dataclass
class Episode:
    """One episode so far."""

    robot: Robot
    index: int  # of the robot in the model's table
    seed: int
    count: int  # frames so far, without those of the start that the model did not see
    frames: deque[np.ndarray]  # tokens [S (, C)] of the newest frames
    chunks: deque[np.ndarray]  # [U], between these frames: one fewer
    pending: list[np.ndarray] = field(default_factory=list)  # native actions [A] of a chunk that is not complete yet

    def max_rewind(self, capacity: int) -> int:
        """The number of frames by which it can be rewound: to its first frame, or as far as a window of `capacity`
        frames is kept."""
        kept = len(self.frames)
        return kept - (1 if kept == self.count else capacity)

    def rewound(self, frames: int) -> Episode:
        """A copy of the episode, `frames` frames earlier."""
        other = copy.deepcopy(self)
        for _ in range(frames):
            other.frames.pop()
            other.chunks.pop()
        other.count, other.pending = self.count - frames, []
        return other


def begin_episode(
    robot: Robot, index: int, start: Start, seed: int, capacity: int, history: int, width: int
) -> Episode:
    """The record of an episode that starts from at most the last `capacity` frames of `start`, with chunks padded to
    `width`. Its `frames` are still empty. Raises ConfigError for actions that do not fit the frames."""
    require_actions_between(start, robot)
    between = len(start.images) - 1
    seen = min(between + 1, capacity)
    chunks = np.zeros((seen - 1, width), np.float32)
    flat = start.actions.reshape(between, robot.stride * robot.action_dim)
    chunks[:, : flat.shape[1]] = flat[between + 1 - seen :]
    kept = capacity + history
    return Episode(robot, index, seed, seen, deque(maxlen=kept), deque(chunks, maxlen=kept - 1))


GROWING_FIELDS = ("frames", "chunks", "pending")
"""Fields of an episode that grow with every frame, besides its count."""


class Snapshot(NamedTuple):
    """The state of all episodes of a simulator at one time."""

    state: Episodes
    images: np.ndarray  # read-only
    episodes: tuple[Episode | None, ...]
    identity: str  # of the model and of the tokenizer


def as_arrays(snapshot: Snapshot) -> dict[str, np.ndarray]:
    """A snapshot as named arrays, for a file: its state, and the GROWING_FIELDS of its episodes, which must all have
    begun."""
    arrays = {"images": snapshot.images, "identity": np.array(snapshot.identity)}
    for i, leaf in enumerate(jax.tree.leaves(snapshot.state)):
        arrays[f"state/{i}"] = np.asarray(leaf)
    for b, episode in enumerate(snapshot.episodes):
        arrays |= {f"episode/{b}/{name}": np.array(list(getattr(episode, name))) for name in GROWING_FIELDS}
        arrays[f"episode/{b}/count"] = np.array(episode.count)
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray], fresh: Snapshot) -> Snapshot:
    """The snapshot that `as_arrays` stored. `fresh` is a snapshot of the same simulator right after the same episodes
    began. Raises KeyError for arrays of other episodes."""
    leaves, tree = jax.tree.flatten(fresh.state)
    # On the same device: otherwise programs would be compiled again. A file stores bfloat16 as raw 16-bit values.
    state = [jax.device_put(arrays[f"state/{i}"].view(x.dtype), x.sharding) for i, x in enumerate(leaves)]
    episodes = copy.deepcopy(fresh.episodes)
    for b, episode in enumerate(episodes):
        episode.count = int(arrays[f"episode/{b}/count"])
        for name in GROWING_FIELDS:
            rows = getattr(episode, name)
            rows.clear()
            rows.extend(arrays[f"episode/{b}/{name}"])
    images = read_only(arrays["images"])
    return Snapshot(tree.unflatten(state), images, episodes, str(arrays["identity"]))
