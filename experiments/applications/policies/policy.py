"""The interface of policies: images in, a robot's raw actions out, frame by frame, for B episodes at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from hma_jax.simulator.robots import Robot


class Policy(Protocol):
    """Acts in B episodes of one robot, and remembers what it needs from each episode's past."""

    def reset(self, episodes: Sequence[int] | None = None, *, seeds: Sequence[int] | None = None) -> None:
        """`episodes` (None: all) begin anew: the next image of each is its first.

        Random numbers of an episode are a function of its seed (None: its number) and of how many actions it has had.
        """
        ...

    def act(self, images: np.ndarray) -> np.ndarray:
        """Actions float32 in the robot's raw units, after images uint8 [B, H, W, 3]: for each frame of the model one
        action [B, A], held for the frame, or its whole chunk [B, stride, A]."""
        ...


class Counts:
    """Counts the actions of each of B episodes, and keeps their seeds. B is known with the first images."""

    def __init__(self):
        self.seeds: dict[int, int] = {}
        self.steps: dict[int, int] = {}

    def reset(self, episodes: Sequence[int] | None, seeds: Sequence[int] | None) -> None:
        if episodes is None:
            self.seeds, self.steps = {}, {}
            episodes = range(len(seeds or ()))
        for i, b in enumerate(episodes):
            self.steps[b] = 0
            self.seeds[b] = b if seeds is None else int(seeds[i])

    def next(self, b: int) -> tuple[int, int]:
        """(seed, actions before) of episode b, which now has one more."""
        step = self.steps.get(b, 0)
        self.steps[b] = step + 1
        return self.seeds.get(b, b), step


class RandomPolicy:
    """Actions that are uniform within the robot's range, each held for `hold` frames; images are ignored."""

    def __init__(self, robot: Robot, hold: int = 3):
        self.robot, self.hold = robot, hold
        self._counts = Counts()

    def reset(self, episodes: Sequence[int] | None = None, *, seeds: Sequence[int] | None = None) -> None:
        self._counts.reset(episodes, seeds)

    def act(self, images: np.ndarray) -> np.ndarray:
        drawn = []
        for b in range(len(images)):
            seed, step = self._counts.next(b)
            rng = np.random.default_rng([seed, step // self.hold, 11])
            drawn.append(rng.uniform(self.robot.low, self.robot.high))
        return np.asarray(drawn, np.float32)
