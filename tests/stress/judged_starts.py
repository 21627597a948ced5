"""How often intervals over starts hold the truth, in simulated judgements whose true rates are known.

Not a test, since it takes an hour of one core: `python -m tests.stress.judged_starts [EACH] [counts]`. Of policies
whose true rates are drawn in a range, and whose rates in the other world are a function of those and of others drawn
alike, outcomes at the same starts are drawn, some starts being harder for all policies and in both worlds. With
`counts`, as of a real robot, one world has so many episodes of each policy instead, at starts of their own. It prints,
of each measure, how often `agree`, or `agree_with_counts`, held that of the true rates: for each range and relation,
number of policies, number of starts or episodes, and in all. EACH (8) judgements are drawn of each combination of
these with `HARD`: 1,512 times EACH, with `counts` 2,016.
"""

from __future__ import annotations

import itertools
import sys
from collections import defaultdict

import numpy as np
from scipy.special import ndtri

from experiments.applications.judging.agreement import MEASURES, agree, agree_with_counts

RANGES = {"0.05 to 0.95": (0.05, 0.95), "0.2 to 0.8": (0.2, 0.8), "0.3 to 0.7": (0.3, 0.7), "0.4 to 0.6": (0.4, 0.6),
          "0.75 to 0.95": (0.75, 0.95), "0.01 to 0.1": (0.01, 0.1)}  # fmt: skip
ONE_APART = "0.85 to 0.95, but one of 0.6"
RELATIONS = {
    "the same": lambda true, other: true,
    "0.6 times": lambda true, other: 0.6 * true,
    "the square": lambda true, other: true**2,
    "a tenth another": lambda true, other: 0.9 * true + 0.1 * other,
    "half another": lambda true, other: 0.5 * true + 0.5 * other,
    "another": lambda true, other: other,
}
HARD = ((0.0, 0.0), (0.3, 0.5), (0.6, 0.9))
"""(correlation of what decides between policies at a start, and of the rest of it between worlds)."""

POLICIES, STARTS = (5, 8, 11, 15), (20, 50, 100)
EPISODES, STARTS_BESIDE = (5, 10, 20, 50), 50
"""Of each policy in the world that is counted, and starts of the other world."""


def draw_true(rng: np.random.Generator, where: str, policies: int) -> np.ndarray:
    """[2, P] rates in a world and others drawn alike."""
    if where != ONE_APART:
        return rng.uniform(*RANGES[where], (2, policies))
    rates = rng.uniform(0.85, 0.95, (2, policies))
    rates[:, 0] = 0.6
    return rates


def outcomes_of(rng: np.random.Generator, rates_2P: np.ndarray, starts: int, hard: tuple[float, float]) -> np.ndarray:
    """bool [2, P, starts] that succeed with `rates_2P`."""
    shape = (*rates_2P.shape, starts)
    start, policy, world = rng.standard_normal(starts), rng.standard_normal(shape[1:]), rng.standard_normal(shape)
    rest = np.sqrt(hard[1]) * policy + np.sqrt(1 - hard[1]) * world
    return np.sqrt(hard[0]) * start + np.sqrt(1 - hard[0]) * rest < ndtri(rates_2P)[..., None]


def main(each: int, counts: bool) -> None:
    rng, said = np.random.default_rng(0), defaultdict(list)
    sizes, of = (EPISODES, "episodes") if counts else (STARTS, "starts")
    for where, relation, policies, size in itertools.product((*RANGES, ONE_APART), RELATIONS, POLICIES, sizes):
        for hard in HARD * each:
            true, other = draw_true(rng, where, policies)
            rates = np.stack([true, RELATIONS[relation](true, other)])
            if counts:
                learned = outcomes_of(rng, rates, STARTS_BESIDE, hard)[1]
                found = agree_with_counts(rng.binomial(size, true), np.full(policies, size), learned, draws=200)
            else:
                found = agree(*outcomes_of(rng, rates, size, hard), draws=200)
            for name in ("pearson", "spearman", "rank violation"):
                if np.isfinite(found.over_starts[name].low):
                    low, high, truth = found.over_starts[name].low, found.over_starts[name].high, MEASURES[name](*rates)
                    held = low - 1e-6 <= truth <= high + 1e-6, truth < low, high - low
                    for part in (f"{where}, {relation}", f"{policies} policies", f"{size} {of}", "all"):
                        said[name, part].append(held)
    for (name, part), held in said.items():
        hold, below, width = np.mean(held, 0)
        print(f"{name}, {part}: held {hold:.3f} of {len(held)}, truth below {below:.3f}, width {width:.2f}", flush=True)


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word != "counts"]
    main(numbers[0] if numbers else 8, "counts" in sys.argv)
