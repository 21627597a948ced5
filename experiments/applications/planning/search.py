"""What all searches share: sequences of actions in units of a robot's range, and how they are spread over frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hma_jax.config import require

Score = Callable[[np.ndarray], np.ndarray]
"""The cost of sequences [B, K, A], float [B], by one batch of the model, always of the same size. Less is better."""


@dataclass(frozen=True)
class SearchConfig:
    """A sequence is K actions, each held for `hold` frames. Values are in units in which the robot's recorded range is
    [-1, 1]. A search scores `iterations` batches of B candidates."""

    candidates: int = 16  # B
    iterations: int = 3
    knots: int = 3  # K
    hold: int = 2
    spread: float = 0.7  # standard deviation of the first candidates
    elites: int = 4  # candidates of a batch around which the next is drawn (CEM)
    momentum: float = 0.1  # share of the former mean and deviation that an update keeps (CEM)
    temperature: float = 0.3  # of the weights exp(-cost / temperature), costs in standard deviations (MPPI)
    least: float = 0.1  # no deviation becomes smaller

    def __post_init__(self):
        require(self.candidates >= 2, f"a search needs at least 2 candidates, got {self.candidates}")
        require(
            self.iterations >= 1 and self.knots >= 1 and self.hold >= 1,
            "iterations, knots and hold must be at least 1",
        )
        require(1 <= self.elites <= self.candidates, f"elites must lie in 1..{self.candidates}, got {self.elites}")
        require(0 <= self.momentum < 1, f"momentum must lie in [0, 1), got {self.momentum}")
        require(self.temperature > 0 and self.spread > 0, "temperature and spread must be positive")

    @property
    def frames(self) -> int:
        """The horizon, in frames of the model."""
        return self.knots * self.hold


def finite_costs(score: Score, candidates: np.ndarray) -> np.ndarray:
    """`score(candidates)`. Raises ConfigError unless it is one finite number for each candidate."""
    costs, count = np.asarray(score(candidates)), len(candidates)
    require(
        costs.shape == (count,), f"a cost must be one number for each candidate, [{count}], got {list(costs.shape)}"
    )
    require(bool(np.isfinite(costs).all()), "the cost of a candidate is not finite")
    return costs


def draw(rng: np.random.Generator, mean: np.ndarray, std: np.ndarray, count: int) -> np.ndarray:
    """`count` normal sequences around `mean` [K, A], within the range: the first is the mean itself."""
    drawn = mean + std * rng.standard_normal((count, *mean.shape))
    drawn[0] = mean
    return np.clip(drawn, -1.0, 1.0)


def warm_start(plan: np.ndarray, config: SearchConfig, frames: int) -> np.ndarray:
    """The warm start of the next search after the first `frames` of `plan` [K, A] were executed: the rest of it, then
    its last action repeated, each action the mean of the frames that it is held for."""
    each = repeat_knots(plan, config)
    rest = np.concatenate([each[frames:], np.repeat(each[-1:], frames, 0)])[: config.frames]
    return rest.reshape(config.knots, config.hold, -1).mean(1)


def repeat_knots(plans: np.ndarray, config: SearchConfig) -> np.ndarray:
    """Expands [..., K, A] to an action for each frame, [..., K hold, A]."""
    return np.repeat(plans, config.hold, axis=-2)
