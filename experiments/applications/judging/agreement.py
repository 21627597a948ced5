"""How well success in the learned simulator predicts success in the true one.

Rates are compared over P policies: Pearson, Spearman (ties averaged), and the mean maximum rank violation, the largest
difference in true rate between a policy and one that the other world ranks the other way round, averaged (Li et al.
2024, "Evaluating Real-World Robot Manipulation Policies in Simulation"; here a tie of the learned rates counts for both
policies).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from experiments.analysis.intervals import LEVEL, Interval
from experiments.applications.judging.true_rates import draw_rates, has_one_apart, noise_of_counts, noise_of_starts

DRAWS = 2000

LEAST_POLICIES = 5
"""Fewest policies for which intervals over policies are given. With fewer, many bootstrap resamples contain one or
two different policies, whose rates have no order or always a perfect one."""

LEAST_STARTS = 20
"""Fewest starts for which intervals over starts are given (`tests/stress/judged_starts.py` measured their coverage)."""

Measure = Callable[[np.ndarray, np.ndarray], float]


def pearson(true: np.ndarray, learned: np.ndarray) -> float:
    """Pearson's correlation; nan if one of the arrays does not vary, and for two policies, for which it is always 1 or
    -1."""
    # The mean of equal rates need not be one of them to the last bit, so the spread says whether they vary.
    if len(true) < 3 or np.ptp(true) == 0 or np.ptp(learned) == 0:
        return math.nan
    a, b = true - true.mean(), learned - learned.mean()
    return float((a * b).sum() / math.sqrt(float((a * a).sum() * (b * b).sum())))


def spearman(true: np.ndarray, learned: np.ndarray) -> float:
    return pearson(rankdata(true), rankdata(learned))


def rank_violation(true: np.ndarray, learned: np.ndarray) -> float:
    """Mean maximum rank violation; 0 if both order the policies alike, nan if the true rates have no order."""
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


@dataclass(frozen=True)
class Agreement:
    """Measures of two worlds' success rates, with intervals over other policies of the same kind and other starts."""

    measures: dict[str, Interval]  # with fewer than LEAST_POLICIES policies only the bias has an interval
    over_starts: dict[str, Interval]  # for the same policies, over other starts only: see `_of_true_rates`


def agree(true_PM: np.ndarray, learned_PM: np.ndarray, draws: int = DRAWS) -> Agreement:
    """The agreement of successes bool [P, M] of P policies at the same M starts.

    Intervals over policies and starts, and all intervals of the bias, are quantiles of `draws` bootstrap resamples. A
    drawn start is drawn in both worlds and for all policies. Draws in which a measure is not defined are left out. Over
    starts only, the intervals of correlations and rank violation come from the same number of draws of true rates
    (`true_rates`).
    """
    draw = lambda columns: true_PM[:, columns].mean(1)  # noqa: E731
    return _agree(true_PM.mean(1), draw, learned_PM, draws, lambda: noise_of_starts(true_PM, learned_PM))


def agree_with_counts(
    successes_P: np.ndarray, episodes_P: np.ndarray, learned_PM: np.ndarray, draws: int = DRAWS
) -> Agreement:
    """Like `agree`, for policies whose successes were counted elsewhere, from other starts. While the model's starts
    are resampled, each of those rates is drawn from its posterior: Beta(s + 1/2, n - s + 1/2) for s successes in n
    episodes (Jeffreys' prior), which leaves uncertainty at 0 and at n too."""
    rng, failures_P = np.random.default_rng([0, 18]), episodes_P - successes_P
    draw = lambda columns: rng.beta(successes_P + 0.5, failures_P + 0.5)  # noqa: E731
    noise = lambda: noise_of_counts(successes_P, episodes_P, learned_PM)  # noqa: E731
    return _agree(successes_P / episodes_P, draw, learned_PM, draws, noise)


def _agree(
    true_P: np.ndarray,
    draw: Callable[[np.ndarray], np.ndarray],
    learned_PM: np.ndarray,
    draws: int,
    noise: Callable[[], np.ndarray],
) -> Agreement:
    """`draw` gives new true rates [P] for drawn starts `columns`; `noise` gives the covariance [P, 2, 2] of the errors
    of measured rates."""
    policies, starts = learned_PM.shape
    learned_P = learned_PM.mean(1)
    drawn: dict[str, list[float]] = {name: [] for name in MEASURES}
    biases = []
    for rows, columns in _resamples(policies, starts, draws):
        rates = draw(columns), learned_PM[:, columns].mean(1)
        biases.append(bias(*rates))
        for name, measure in MEASURES.items():
            drawn[name].append(measure(rates[0][rows], rates[1][rows]))
    value = {name: measure(true_P, learned_P) for name, measure in MEASURES.items()}
    size = {"n": policies * starts, "episodes": starts}
    if policies < LEAST_POLICIES:
        drawn.update({name: [] for name in MEASURES if name != "bias"})
    both = {name: _interval(value[name], np.array(found), size) for name, found in drawn.items()}
    alone = {name: _interval(x, np.array([]), size) for name, x in value.items()}
    if policies > 1 and starts >= LEAST_STARTS:
        measured = np.stack([true_P, learned_P], 1), noise()
        rates_nP2, known = draw_rates(*measured, draws), set(MEASURES)
        if has_one_apart(*measured):  # the outlier would be taken for the order of the others
            known -= {"spearman"}
        alone |= {name: _of_true_rates(alone[name], MEASURES[name], rates_nP2) for name in known}
    # What all rates of a world have in common, and so the bias, is not part of those draws.
    return Agreement(both, {**alone, "bias": _interval(value["bias"], np.array(biases), size)})


def share(same_PM: np.ndarray, among_PM: np.ndarray, draws: int = DRAWS) -> Interval:
    """The share of the episodes `among_PM` that are `same_PM`, both bool [P, M] of P policies at the same M starts.

    Episodes of one policy, and of one start, resemble each other, so the interval is over other policies and starts. It
    is never narrower than Wilson's, which is valid at 0 and 1, where resampling shows no spread.
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
    average; the interval is over other policies and starts. If all differ alike, resampling shows no spread: the
    interval then allows a difference of one, up or down, in as many episodes as Wilson's interval for zero successes
    does."""
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


def _of_true_rates(measured: Interval, measure: Measure, rates_nP2: np.ndarray) -> Interval:
    """The interval over starts: `measure` for draws of the true rates. It is widened to contain the `measured` value,
    which noise may have put outside all draws."""
    if not math.isfinite(measured.mean):
        return measured
    size = {"n": measured.n, "episodes": measured.episodes}
    drawn = _interval(measured.mean, np.array([measure(*rates.T) for rates in rates_nP2]), size)
    return dataclasses.replace(drawn, low=min(drawn.low, drawn.mean), high=min(max(drawn.high, drawn.mean), 1.0))


def rate_interval(successes: np.ndarray) -> Interval:
    """The interval of a success rate from outcomes, bool [n]; see `count_interval`."""
    return count_interval(int(np.sum(successes)), len(successes))


def count_interval(successes: int, n: int) -> Interval:
    """Wilson's score interval of a success rate; it is valid at 0 and 1 too (Wilson 1927, JASA 22)."""
    rate, z = successes / n, 1.959964
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    low = centre - half if rate > 0 else 0.0  # to the last bit, or a figure's error bar would have a negative length
    high = centre + half if rate < 1 else 1.0
    return Interval(rate, math.sqrt(rate * (1 - rate) / n), low, high, n, n)
