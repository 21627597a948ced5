"""What a robot does: an expert that is noisy and now and then loses its head, or wandering.

Noise and lapses make failures and make actions informative: a model that has seen experts alone
cannot tell what another action would have done. Knows actions only, no simulator.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_pipelines.simulators.spec import SimSpec

LEVELS = (0.0, 0.25, 0.5, 1.0)
"""An episode's share of its dataset's noise, drawn evenly. At 0 the expert is left alone."""

LAPSES = 0.5
"""Lapses per second at level 1."""

LAPSE_SECONDS = (0.3, 1.2)

SETTLED = 1.0
"""Seconds for which an expert goes on after its success; then it wanders, so that things move."""

Expert = Callable[[], np.ndarray]
"""The action that an expert takes in the simulator's present state, raw units."""


class Wander:
    """Smooth noise that grows from 0 to variance 1: an Ornstein-Uhlenbeck process per dimension."""

    def __init__(self, dim: int, steps: float, rng: np.random.Generator):
        """`steps`: how many it takes to forget."""
        self.keep = float(np.exp(-1.0 / max(steps, 1e-6)))
        self.rng = rng
        self.value = np.zeros(dim)

    def step(self) -> np.ndarray:
        fresh = self.rng.standard_normal(self.value.shape)
        self.value = self.keep * self.value + np.sqrt(1 - self.keep**2) * fresh
        return self.value


class Behaviour:
    """The actions of one episode, in [low, high]. `rest` is the action that does nothing."""

    def __init__(
        self,
        spec: SimSpec,
        low: np.ndarray,
        high: np.ndarray,
        rest: np.ndarray,
        expert: Expert | None,
        rng: np.random.Generator,
    ):
        self.spec, self.low, self.high, self.rest, self.expert, self.rng = spec, low, high, rest, expert, rng
        self.reach = spec.gain * (high - low) / 2
        self.level = float(rng.choice(LEVELS))
        self.wander = Wander(len(low), spec.tau * spec.hz, rng)
        self.jitter = Wander(len(low), 0.1 * spec.hz, rng)
        self.lapse = 0  # frames left
        self.settled = 0  # frames since success

    def act(self, reached: bool) -> np.ndarray:
        """float32 [A]: the next action; `reached` says whether the goal has been, at any time."""
        wander = self.rest + self.reach * self.wander.step()
        jitter = self.jitter.step()
        lapsing = self._lapsing()
        self.settled += reached
        if self.expert is None or lapsing or self.settled > SETTLED * self.spec.hz:
            action = wander
        else:
            action = self.expert() + self.level * self.spec.noise * (self.high - self.low) / 2 * jitter
        return np.clip(action, self.low, self.high).astype(np.float32)

    def _lapsing(self) -> bool:
        start, duration = self.rng.random(), self.rng.uniform(*LAPSE_SECONDS)
        if self.lapse:
            self.lapse -= 1
        elif start < self.level * LAPSES / self.spec.hz:
            self.lapse = round(duration * self.spec.hz)
        return self.lapse > 0
