"""Model-predictive path integral control (Williams et al. 2017): the mean moves towards all candidates, each weighted
by how low its cost is."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import Score, SearchConfig, draw, finite_costs


def plan_mppi(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The weighted mean [K, A] after the last batch, from `mean` on.

    The deviation shrinks to `config.least` over the iterations, as it has few of them.
    """
    for i in range(config.iterations):
        share = i / max(config.iterations - 1, 1)
        std = np.full(mean.shape, config.spread ** (1 - share) * config.least**share)
        candidates = draw(rng, mean, std, config.candidates)
        costs = finite_costs(score, candidates)
        weights = np.exp((costs.min() - costs) / (config.temperature * max(costs.std(), 1e-12)))
        mean = np.einsum("b,bka->ka", weights / weights.sum(), candidates)
    return mean
