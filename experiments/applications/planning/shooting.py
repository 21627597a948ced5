"""Random shooting: as many candidates as another search, all drawn before any is scored."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import Score, SearchConfig, finite_costs


def plan_shooting(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The cheapest of `iterations` x B sequences [K, A] that are uniform over the range. `mean` gives only their
    shape."""
    batches = rng.uniform(-1.0, 1.0, (config.iterations, config.candidates, *mean.shape))
    costs = np.concatenate([finite_costs(score, candidates) for candidates in batches])
    return batches.reshape(-1, *mean.shape)[costs.argmin()]
