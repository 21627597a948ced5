"""The interface of policies: images in, a robot's raw actions out, frame by frame, for B episodes at once."""

from __future__ import annotations

import sys
from typing import Protocol

import numpy as np

from hma_jax.config import require
from hma_jax.simulator.interface import WholeNumbers, chosen_episodes, whole_numbers
from hma_jax.simulator.robots import Robot


class Policy(Protocol):
    """Acts in B episodes of one robot, and remembers what it needs from each episode's past."""

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
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
        self.count = sys.maxsize  # B, once that is known
        self.seeds: dict[int, int] = {}
        self.steps: dict[int, int] = {}

    def reset(self, episodes: WholeNumbers | None, seeds: WholeNumbers | None) -> list[int]:
        """The numbers of `episodes`, or of `seeds` if all begin anew. Raises ConfigError, before anything has changed,
        for episodes that do not exist and unless each has a seed."""
        given = None if seeds is None else whole_numbers("seeds", seeds)
        which = list(range(len(given or ()))) if episodes is None else chosen_episodes(episodes, self.count)
        numbers = which if given is None else given
        require(len(numbers) == len(which), f"{len(which)} episodes need as many seeds, got {len(numbers)}")
        if episodes is None:
            self.count, self.seeds, self.steps = sys.maxsize, {}, {}
        self.steps |= dict.fromkeys(which, 0)
        self.seeds |= zip(which, numbers, strict=True)
        return which

    def next(self, count: int) -> list[tuple[int, int]]:
        """(seed, actions before) of each of `count` episodes, which now have one more."""
        self.count = count
        before = [(self.seeds.get(b, b), self.steps.get(b, 0)) for b in range(count)]
        self.steps |= {b: step + 1 for b, (_, step) in enumerate(before)}
        return before


class RandomPolicy:
    """Actions that are uniform within the robot's range, each held for `hold` frames; images are ignored."""

    def __init__(self, robot: Robot, hold: int = 3):
        self.robot, self.hold = robot, hold
        self._counts = Counts()

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
        self._counts.reset(episodes, seeds)

    def act(self, images: np.ndarray) -> np.ndarray:
        drawn = []
        for seed, step in self._counts.next(len(images)):
            rng = np.random.default_rng([seed, step // self.hold, 11])
            drawn.append(rng.uniform(self.robot.low, self.robot.high))
        return np.asarray(drawn, np.float32)
