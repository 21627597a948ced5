"""Model-predictive path integral control (Williams et al. 2017): the mean moves to all candidates, each weighted by how
little it costs."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import Best, Found, Score, SearchConfig, draw


def plan_mppi(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> Found:
    """The weighted mean after the last batch, from `mean` [K, A] on; its `cost` is the least that was seen.

    The deviation shrinks to `config.least` over the iterations, as it has few of them.
    """
    best = Best()
    for i in range(config.iterations):
        share = i / max(config.iterations - 1, 1)
        std = np.full(mean.shape, config.spread ** (1 - share) * config.least**share)
        candidates = draw(rng, mean, std, config.candidates)
        costs = score(candidates)
        best.see(candidates, costs)
        weights = np.exp((costs.min() - costs) / (config.temperature * max(costs.std(), 1e-12)))
        mean = np.einsum("b,bka->ka", weights / weights.sum(), candidates)
    return Found(mean, best.cost, np.array(best.costs))
