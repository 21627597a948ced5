"""A physics simulator that anyone has: a hand on a line; its drawer is open once the hand is far enough to the right.
Like a real one it remembers something that is not in its physics: how many steps it took, which the last colour
shows."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.simulators import backends, simulator
from data_pipelines.simulators.spec import SimSpec

OPEN = 0.5


class Points:
    def __init__(self, spec: SimSpec, size: int):
        self.size, self.low, self.high = size, -np.ones(spec.action_dim), np.ones(spec.action_dim)

    def start(self, env: str, seed: int) -> None:
        self.x = np.random.default_rng([len(env), seed]).uniform(0, 0.1, len(self.low))
        self.steps = 0

    def rest(self) -> np.ndarray:
        return np.zeros_like(self.low)

    def expert(self):
        return lambda: np.where(self.x < OPEN + 0.1, 1.0, 0.0)

    def step(self, action: np.ndarray) -> tuple[float, bool]:
        self.x = self.x + 0.01 * np.clip(action, self.low, self.high)
        self.steps += 1
        return 0.0, bool(self.x[0] > OPEN)

    def physics(self) -> np.ndarray:
        return self.x.copy()

    def set_physics(self, values: np.ndarray) -> None:
        self.x = values.copy()

    def frame(self) -> np.ndarray:
        frame = np.full((self.size, self.size, 3), np.clip(128 + 200 * self.x[0], 0, 255), np.uint8)
        frame[..., 2] = self.steps % 256
        return frame

    def close(self) -> None:
        self.size = 0


def use_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every robot of a physics simulator is a point now, whatever is installed."""
    monkeypatch.setattr(backends, "open_simulator", Points)
    monkeypatch.setattr(simulator, "require_packages", lambda specs: None)
    monkeypatch.setattr(simulator, "prepare_process", lambda: None)
