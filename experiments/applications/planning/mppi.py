"""Model-predictive path integral control (Williams et al. 2017): the mean moves to all candidates, each weighted by how
little it costs."""

from __future__ import annotations

import numpy as np

from experiments.applications.planning.search import BestPlan, Score, SearchConfig, SearchResult, draw


def plan_mppi(score: Score, config: SearchConfig, mean: np.ndarray, rng: np.random.Generator) -> SearchResult:
    """The weighted mean after the last batch, from `mean` [K, A] on; its `cost` is the least that was seen.

    The deviation shrinks to `config.least` over the iterations, as it has few of them.
    """
    best = BestPlan()
    for i in range(config.iterations):
        share = i / max(config.iterations - 1, 1)
        std = np.full(mean.shape, config.spread ** (1 - share) * config.least**share)
        candidates = draw(rng, mean, std, config.candidates)
        costs = score(candidates)
        best.update(candidates, costs)
        weights = np.exp((costs.min() - costs) / (config.temperature * max(costs.std(), 1e-12)))
        mean = np.einsum("b,bka->ka", weights / weights.sum(), candidates)
    return SearchResult(mean, best.cost, np.array(best.costs))
