"""The behaviour policy of simulated robots: an expert with noise and lapses, or a random walk ("wanders").

Noise and lapses cause failures and make actions informative: a model that has only seen experts cannot predict what
other actions lead to. Knows actions only, no simulator.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_pipelines.simulators.spec import SimSpec

LEVELS = (0.0, 0.25, 0.5, 1.0)
"""Factors of the dataset's noise, one of which is drawn per episode. At 0 the expert acts without noise or lapses."""

LAPSES = 0.5
"""Lapses per second at level 1. During a lapse the robot follows the random walk in place of the expert."""

LAPSE_SECONDS = (0.3, 1.2)

SECONDS_AFTER_SUCCESS = 1.0
"""Seconds for which an expert continues after its success. Then the random walk takes over: things keep moving."""

Expert = Callable[[], np.ndarray]
"""Gives the expert's action for the current state of the simulator, in raw units."""


class OrnsteinUhlenbeck:
    """An Ornstein-Uhlenbeck process per dimension: smooth noise that starts at 0 and tends to variance 1."""

    def __init__(self, dim: int, steps: float, rng: np.random.Generator):
        """`steps`: the correlation time, in steps."""
        self.decay = float(np.exp(-1.0 / max(steps, 1e-6)))
        self.rng = rng
        self.value = np.zeros(dim)

    def step(self) -> np.ndarray:
        fresh = self.rng.standard_normal(self.value.shape)
        self.value = self.decay * self.value + np.sqrt(1 - self.decay**2) * fresh
        return self.value


class Behaviour:
    """The actions of one episode, in [low, high] rounded to float32. `rest` is the action that does nothing."""

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
        self.walk = OrnsteinUhlenbeck(len(low), spec.tau * spec.hz, rng)
        self.jitter = OrnsteinUhlenbeck(len(low), 0.1 * spec.hz, rng)
        self.lapse = 0  # frames left
        self.steps_since_success = 0  # frames since success

    def act(self, reached: bool) -> np.ndarray:
        """float32 [A]: the next action; `reached`: whether the goal has been reached at any time."""
        walk = self.rest + self.reach * self.walk.step()
        jitter = self.jitter.step()
        lapsing = self._lapsing()
        self.steps_since_success += reached
        if self.expert is None or lapsing or self.steps_since_success > SECONDS_AFTER_SUCCESS * self.spec.hz:
            action = walk
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
