"""Random shooting: as many candidates as another search, all drawn before any is scored."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import BestPlan, Score, SearchConfig, SearchResult


def plan_shooting(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> SearchResult:
    """The cheapest of `iterations` x B sequences that are uniform over the range. `mean` gives their shape alone."""
    best = BestPlan()
    for candidates in rng.uniform(-1.0, 1.0, (config.iterations, config.candidates, *mean.shape)):
        best.update(candidates, score(candidates))
    return best.result()
