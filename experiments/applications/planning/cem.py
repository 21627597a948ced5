"""The cross-entropy method (Rubinstein 1999): candidates are drawn from a normal distribution that is repeatedly fitted
to the best of them."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import Score, SearchConfig, draw, finite_costs


def plan_cem(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The cheapest sequence seen, [K, A], from `mean` on. The best of a batch is among the candidates of the next."""
    std, best, least = np.full(mean.shape, config.spread), mean, np.inf
    for i in range(config.iterations):
        candidates = draw(rng, mean, std, config.candidates)
        if i:
            candidates[-1] = best
        costs = finite_costs(score, candidates)
        if costs.min() < least:
            best, least = candidates[costs.argmin()], costs.min()
        elites = candidates[np.argsort(costs, kind="stable")[: config.elites]]
        mean = config.momentum * mean + (1 - config.momentum) * elites.mean(0)
        std = np.maximum(config.momentum * std + (1 - config.momentum) * elites.std(0), config.least)
    return best
