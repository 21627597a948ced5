"""How well success in the learned simulator tells success in the true one.

Rates are compared over P policies: Pearson, Spearman (ties averaged), and the mean maximum rank violation, the largest
difference of true rates between a policy and one that the other world ranks otherwise, averaged (Li et al. 2024,
"Evaluating Real-World Robot Manipulation Policies in Simulation"; here a tie of the learned rates counts for both).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from experiments.analysis.intervals import LEVEL, Interval

DRAWS = 2000

LEAST_POLICIES = 5
"""Of which intervals of correlations and rank violation over policies are known: of fewer, many resamples have one or
two different policies, which have no order or are always in perfect order or disorder."""

Measure = Callable[[np.ndarray, np.ndarray], float]


def pearson(true: np.ndarray, learned: np.ndarray) -> float:
    """nan where one of them does not vary, and of two, of which it is 1 or -1 whatever they are."""
    if (
        len(true) < 3 or np.ptp(true) == 0 or np.ptp(learned) == 0
    ):  # the mean of equal rates need not be one of them to the last bit
        return math.nan
    a, b = true - true.mean(), learned - learned.mean()
    return float((a * b).sum() / math.sqrt(float((a * a).sum() * (b * b).sum())))


def spearman(true: np.ndarray, learned: np.ndarray) -> float:
    return pearson(rankdata(true), rankdata(learned))


def rank_violation(true: np.ndarray, learned: np.ndarray) -> float:
    """Mean maximum rank violation; 0 where both order the policies alike, nan where the true rates have no order."""
    if np.ptp(true) == 0:
        return math.nan
    gap = np.abs(true[:, None] - true[None])
    wrong = np.sign(true[:, None] - true[None]) != np.sign(learned[:, None] - learned[None])
    return float(np.where(wrong, gap, 0.0).max(1).mean())


def bias(true: np.ndarray, learned: np.ndarray) -> float:
    """By how much the learned rates are higher, on average."""
    return float((learned - true).mean())


MEASURES: dict[str, Measure] = {
    "pearson": pearson,
    "spearman": spearman,
    "rank violation": rank_violation,
    "bias": bias,
}

LOWEST = {"pearson": -1.0, "spearman": -1.0, "rank violation": 0.0, "bias": -1.0}
"""Value that each measure cannot be below; none can be above 1."""


@dataclass(frozen=True)
class Agreement:
    """Measures of two worlds' success rates, with intervals over other policies of the kind and other starts."""

    measures: dict[str, Interval]  # of fewer than LEAST_POLICIES without the interval, but for the bias
    over_starts: dict[str, Interval]  # of these policies, were there no end of starts: see `_to_both_sides`


def agree(true_PM: np.ndarray, learned_PM: np.ndarray, draws: int = DRAWS) -> Agreement:
    """From successes bool [P, M] of P policies at the same M starts.

    Intervals are of `draws` bootstrap resamples: over policies and starts their quantiles, over starts alone reaching
    as far to both sides of the measured value. A start drawn is drawn in both worlds and for all policies. Draws in
    which a measure is not defined are left out.
    """
    return _agree(true_PM.mean(1), lambda columns: true_PM[:, columns].mean(1), learned_PM, draws)


def agree_with_counts(
    successes_P: np.ndarray, episodes_P: np.ndarray, learned_PM: np.ndarray, draws: int = DRAWS
) -> Agreement:
    """As `agree`, of policies of which elsewhere so many of so many episodes succeeded. Those are of other starts:
    while the model's are resampled, each rate is drawn from what its count tells of it: Beta(s + 1/2, n - s + 1/2) of s
    successes in n episodes (Jeffreys' prior), which leaves doubt at 0 and at n too."""
    rng, failures_P = np.random.default_rng([0, 18]), episodes_P - successes_P
    draw = lambda columns: rng.beta(successes_P + 0.5, failures_P + 0.5)  # noqa: E731
    return _agree(successes_P / episodes_P, draw, learned_PM, draws)


def _agree(
    true_P: np.ndarray, draw: Callable[[np.ndarray], np.ndarray], learned_PM: np.ndarray, draws: int
) -> Agreement:
    """`draw` gives true rates [P] anew, where the starts drawn are `columns`."""
    policies, starts = learned_PM.shape
    drawn_measures: tuple[dict[str, list[float]], ...] = (
        {name: [] for name in MEASURES},
        {name: [] for name in MEASURES},
    )
    for rows, columns in _resamples(policies, starts, draws):
        rates = draw(columns), learned_PM[:, columns].mean(1)
        for kept, which in zip(drawn_measures, (rows, slice(None)), strict=True):
            for name, measure in MEASURES.items():
                kept[name].append(measure(rates[0][which], rates[1][which]))
    value = {name: measure(true_P, learned_PM.mean(1)) for name, measure in MEASURES.items()}
    size = {"n": policies * starts, "episodes": starts}
    if policies < LEAST_POLICIES:
        drawn_measures[0].update({name: [] for name in MEASURES if name != "bias"})
    both, alone = (
        {name: _interval(value[name], np.array(drawn), size) for name, drawn in kept.items()} for kept in drawn_measures
    )
    return Agreement(both, {name: _to_both_sides(interval, LOWEST[name]) for name, interval in alone.items()})


def share(same_PM: np.ndarray, among_PM: np.ndarray, draws: int = DRAWS) -> Interval:
    """How many of the episodes `among_PM` are `same_PM`, both bool [P, M] of P policies at the same M starts.

    Episodes of one policy, and of one start, resemble each other, so the interval is over other policies and starts;
    but nowhere narrower than Wilson's, which holds at 0 and 1, where resampling knows no spread.
    """
    alike = same_PM & among_PM
    wilson = rate_interval(same_PM[among_PM])
    grids = (np.ix_(rows, columns) for rows, columns in _resamples(*same_PM.shape, draws))
    counts = [(alike[grid].sum(), among_PM[grid].sum()) for grid in grids]
    drawn = np.array([found / n for found, n in counts if n])
    clustered = _interval(wilson.mean, drawn, {"n": wilson.n, "episodes": wilson.episodes})
    if not math.isfinite(clustered.low):
        return wilson
    return dataclasses.replace(clustered, low=min(clustered.low, wilson.low), high=max(clustered.high, wilson.high))


def mean_above(a_PM: np.ndarray, b_PM: np.ndarray, draws: int = DRAWS) -> Interval:
    """By how much the success of P policies at M starts is higher in `a_PM` than in `b_PM`, both bool [P, M], on
    average; over other policies and starts. Where all differ alike, resampling knows no spread: as many episodes as
    Wilson's interval of none of them allows may then differ by one more or less."""
    apart = a_PM.astype(float) - b_PM
    drawn = np.array([apart[np.ix_(rows, columns)].mean() for rows, columns in _resamples(*apart.shape, draws)])
    above = _interval(float(apart.mean()), drawn, {"n": apart.size, "episodes": apart.shape[1]})
    if np.ptp(apart) > 0:
        return above
    others = count_interval(0, apart.size).high
    return dataclasses.replace(above, low=max(above.mean - others, -1.0), high=min(above.mean + others, 1.0))


def _resamples(policies: int, starts: int, draws: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Policies and starts, drawn with replacement."""
    rng = np.random.default_rng(0)
    for _ in range(draws):
        columns = rng.integers(starts, size=starts)
        yield rng.integers(policies, size=policies), columns


def _interval(value: float, drawn: np.ndarray, size: dict[str, int]) -> Interval:
    known = drawn[np.isfinite(drawn)]
    if len(known) < 2:
        return Interval(value, math.nan, math.nan, math.nan, **size)
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(value, float(known.std(ddof=1)), float(low), float(high), **size)


def _to_both_sides(drawn: Interval, lowest: float) -> Interval:
    """As far to either side of the value as quantiles of resampled starts are on the side where they are further.

    Measured rates have the noise of so many starts, and a resample has it twice: correlations of resamples are too low,
    rank violations too high, while the truth lies on the other side of the value. In simulated judgements with other
    true rates, spreads of policies and shared difficulties of starts, such intervals held the truth of 50 starts in
    96 % (Pearson), 95 % (Spearman) and 94 % (rank violation), of 20 starts in 92, 90 and 92 %; the quantiles themselves
    in 59, 68 and 61 % of both. Quantiles over policies too, which spread more, held it in 95 % (Pearson) where the true
    rates of the two worlds differ.
    """
    furthest = max(drawn.mean - drawn.low, drawn.high - drawn.mean)
    return dataclasses.replace(drawn, low=max(drawn.mean - furthest, lowest), high=min(drawn.mean + furthest, 1.0))


def rate_interval(successes: np.ndarray) -> Interval:
    """Of the success rate of episodes, bool [n], see `count_interval`."""
    return count_interval(int(np.sum(successes)), len(successes))


def count_interval(successes: int, n: int) -> Interval:
    """Of a success rate: Wilson's score interval, which holds at 0 and 1 too (Wilson 1927, JASA 22)."""
    rate, z = successes / n, 1.959964
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    low = centre - half if rate > 0 else 0.0  # to the last bit, or a figure's error bar would have a negative length
    high = centre + half if rate < 1 else 1.0
    return Interval(rate, math.sqrt(rate * (1 - rate) / n), low, high, n, n)
