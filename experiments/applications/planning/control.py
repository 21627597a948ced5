"""Receding-horizon control: the first actions of a plan are executed, then a new plan is made from what is observed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from experiments.applications.planning.goals import Cost
from experiments.applications.planning.models import Model
from experiments.applications.planning.search import Score, SearchConfig, repeat_knots, warm_start
from hma_jax.config import require
from hma_jax.simulator.robots import Robot

Search = Callable[[Score, SearchConfig, np.ndarray, np.random.Generator], np.ndarray]
"""A search for the cheapest plan [K, A], given the mean [K, A] to begin with."""


@dataclass(frozen=True)
class ActionRange:
    """Maps a robot's recorded action range to [-1, 1], and back."""

    low: np.ndarray  # [A]
    high: np.ndarray
    rest: np.ndarray  # in these units

    @classmethod
    def of(cls, robot: Robot) -> ActionRange:
        low, high = np.array(robot.low, np.float32), np.array(robot.high, np.float32)
        half = np.maximum((high - low) / 2, 1e-9)
        return cls(low, high, (np.array(robot.rest, np.float32) - low) / half - 1)

    def denormalise(self, values: np.ndarray) -> np.ndarray:
        raw = self.low + (values + 1) * (self.high - self.low) / 2
        return np.clip(raw, self.low, self.high).astype(np.float32)  # rounding may take the ends beyond the range


class Planner:
    """Plans for one episode; each search starts from the rest of the last plan."""

    def __init__(self, search: Search, config: SearchConfig, model: Model, robot: Robot, cost: Cost, seed: int):
        """Random numbers depend on `seed` and on how many plans were made."""
        self._search, self._config, self._model, self._units = search, config, model, ActionRange.of(robot)
        self._cost, self._seed, self._plans = cost, seed, 0
        self._mean = np.repeat(self._units.rest[None], config.knots, 0)

    def plan(self, execute: int) -> np.ndarray:
        """Raw actions [execute, A], one for each frame, from the state that the model observed last. Raises ConfigError
        unless `execute` lies in 1..frames of a plan."""
        most = self._config.frames
        require(1 <= execute <= most, f"execute must lie in 1..{most}, the frames of a plan, got {execute}")

        def score(candidates: np.ndarray) -> np.ndarray:
            actions = self._units.denormalise(repeat_knots(candidates, self._config))
            return self._cost(self._model.imagine(actions))

        rng = np.random.default_rng([self._seed, self._plans])
        plan = self._search(score, self._config, self._mean, rng)
        self._plans += 1
        self._mean = warm_start(plan, self._config, execute)
        return self._units.denormalise(repeat_knots(plan, self._config)[:execute])
