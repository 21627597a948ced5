"""Planning while acting: some actions of a plan are carried out, what they did is seen, and a new plan is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from experiments.applications.planning.goals import Cost
from experiments.applications.planning.models import Model
from experiments.applications.planning.search import Found, Score, SearchConfig, over_frames, shifted
from hma_jax.simulator.robots import Robot

Search = Callable[[Score, SearchConfig, np.ndarray, np.random.Generator], Found]


@dataclass(frozen=True)
class Units:
    """A robot's recorded range as [-1, 1], and back."""

    low: np.ndarray  # [A]
    high: np.ndarray
    rest: np.ndarray  # in these units

    @classmethod
    def of(cls, robot: Robot) -> Units:
        low, high = np.array(robot.low, np.float32), np.array(robot.high, np.float32)
        half = np.maximum((high - low) / 2, 1e-9)
        return cls(low, high, (np.array(robot.rest, np.float32) - low) / half - 1)

    def raw(self, values: np.ndarray) -> np.ndarray:
        return (self.low + (values + 1) * (self.high - self.low) / 2).astype(np.float32)


class Planner:
    """One episode's: remembers what is left of the last plan."""

    def __init__(self, search: Search, config: SearchConfig, model: Model, robot: Robot, cost: Cost, seed: int):
        """What is random depends on `seed` and on how many plans were made."""
        self._search, self._config, self._model, self._units = search, config, model, Units.of(robot)
        self._cost, self._seed, self._plans = cost, seed, 0
        self._mean = np.repeat(self._units.rest[None], config.knots, 0)

    def plan(self, execute: int) -> np.ndarray:
        """Raw actions [execute, A], one for each frame, from the present that the model was given."""

        def score(candidates: np.ndarray) -> np.ndarray:
            actions = self._units.raw(over_frames(candidates, self._config))
            return self._cost(self._model.imagine(actions))

        rng = np.random.default_rng([self._seed, self._plans])
        found = self._search(score, self._config, self._mean, rng)
        self._plans += 1
        self._mean = shifted(found.plan, self._config, execute)
        return self._units.raw(over_frames(found.plan, self._config)[:execute])
