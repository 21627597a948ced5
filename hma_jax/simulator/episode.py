"""What the host knows of a simulated episode: enough to take it back, and to say where it stands."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np

from hma_jax.config import require
from hma_jax.generation.episodes import Episodes
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start


@dataclass
class Episode:
    """One episode so far."""

    robot: Robot
    index: int  # of the robot in the model's table
    seed: int
    count: int  # frames so far, of those that the model saw
    frames: deque[np.ndarray]  # tokens [S (, C)] of the newest of them
    chunks: deque[np.ndarray]  # [U], between them: one fewer
    pending: list[np.ndarray] = field(default_factory=list)  # native actions [A] that no frame has come of yet

    def reach(self, room: int) -> int:
        """By how many frames it can be taken back: to its first, or to where the window of `room` is still kept."""
        kept = len(self.frames)
        return kept - (1 if kept == self.count else room)

    def earlier(self, frames: int) -> Episode:
        """A copy that stands so many frames before."""
        other = copy.deepcopy(self)
        for _ in range(frames):
            other.frames.pop()
            other.chunks.pop()
        other.count, other.pending = self.count - frames, []
        return other


def begin_episode(robot: Robot, index: int, start: Start, seed: int, room: int, history: int, width: int) -> Episode:
    """An episode that has seen the last `room` frames of `start` at most, its chunks padded to `width`; its tokens
    are still missing. Raises ConfigError for actions that do not fit the frames."""
    between = len(start.images) - 1
    require(
        start.actions.shape == (between * robot.stride, robot.action_dim),
        f"a start of {robot.name}: {between + 1} frames have {between} x {robot.stride} actions of "
        f"{robot.action_dim} values between them, got {start.actions.shape}",
    )
    seen = min(between + 1, room)
    chunks = np.zeros((seen - 1, width), np.float32)
    flat = start.actions.reshape(between, robot.stride * robot.action_dim)
    chunks[:, : flat.shape[1]] = flat[between + 1 - seen :]
    kept = room + history
    return Episode(robot, index, seed, seen, deque(maxlen=kept), deque(chunks, maxlen=kept - 1))


CHANGING = ("frames", "chunks", "pending")
"""What of an episode grows while it goes on, besides its count."""


class Snapshot(NamedTuple):
    """Where all episodes of a simulator stood."""

    state: Episodes
    images: np.ndarray
    episodes: tuple[Episode | None, ...]


def as_arrays(snapshot: Snapshot) -> dict[str, np.ndarray]:
    """A snapshot as a file keeps it; of its episodes, all of which must have begun, what has changed since."""
    arrays = {"images": snapshot.images}
    for i, leaf in enumerate(jax.tree.leaves(snapshot.state)):
        arrays[f"state/{i}"] = np.asarray(leaf)
    for b, episode in enumerate(snapshot.episodes):
        arrays |= {f"episode/{b}/{name}": np.array(list(getattr(episode, name))) for name in CHANGING}
        arrays[f"episode/{b}/count"] = np.array(episode.count)
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray], begun: Snapshot) -> Snapshot:
    """What `as_arrays` kept, of a simulator whose same episodes have `begun` again. KeyError for arrays of others."""
    leaves, tree = jax.tree.flatten(begun.state)
    # Where they lay, or programs would be compiled once more; a file knows bfloat16 by its width alone.
    state = [jax.device_put(arrays[f"state/{i}"].view(x.dtype), x.sharding) for i, x in enumerate(leaves)]
    episodes = copy.deepcopy(begun.episodes)
    for b, episode in enumerate(episodes):
        episode.count = int(arrays[f"episode/{b}/count"])
        for name in CHANGING:
            rows = getattr(episode, name)
            rows.clear()
            rows.extend(arrays[f"episode/{b}/{name}"])
    return Snapshot(tree.unflatten(state), arrays["images"], episodes)
