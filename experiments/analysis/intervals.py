"""Means with intervals: clustered by episode within a robot, all robots counting equally over them.

Standard errors are `hma_jax.evaluation.statistics.stat_of`: cluster-robust over episodes (Cameron and Miller 2015,
"A Practitioner's Guide to Cluster-Robust Inference", for a regression on a constant, with G / (G - 1)). Intervals
take Student's t with G - 1 degrees of freedom for G episodes (ibid., section VI), and for the mean over robots the
number that Satterthwaite 1946 gives for a sum of estimated variances.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from scipy.special import stdtrit

from hma_jax.evaluation.statistics import Stat, stratified
from hma_jax.evaluation.sums import add_up

OVERALL = "overall"
"""The scope that averages over all robots that are judged, each counting equally."""

LEVEL = 0.95
"""Confidence level of intervals of means and differences; fits have `fits.FIT_LEVEL`."""

HELD_OUT_LOSS = "cross_entropy"
"""Nats per held-out token, which models of latents do not have: the metric that is fitted. Its exponential, the
perplexity, is not a sum of powers."""

NATS = (HELD_OUT_LOSS, "diffusion_loss", "action_nats")
"""Metrics in nats per token (the diffusion loss in its own unit), which come first in every table."""


@dataclass(frozen=True)
class Interval:
    """A mean with its standard error and the interval that holds the truth in `LEVEL` of all samples.

    nan where it is unknown: one episode does not show how episodes differ.
    """

    mean: float
    sem: float
    low: float
    high: float
    n: int = 0  # windows
    episodes: int = 0  # episodes that these windows come from

    @property
    def errors(self) -> float:
        """`standard_errors` of the mean."""
        return standard_errors(self.mean, self.sem)

    def of_share(self) -> Interval:
        """The interval of a mean of shares, each from 0 to 1; the interval stays within that range.

        Windows that are all 0, or all 1, do not scatter, and Student's t would be sure after a few of them. Their
        interval is that of Clopper and Pearson 1934 for one independent trial per episode, all of which failed or
        succeeded. nan stays nan.
        """
        low, high = max(self.low, 0.0), min(self.high, 1.0)
        if self.sem == 0 and self.mean in (0, 1):
            beyond = 1 - ((1 - LEVEL) / 2) ** (1 / self.episodes)
            low, high = (0.0, beyond) if self.mean == 0 else (1 - beyond, 1.0)
        return replace(self, low=low, high=high)

    def exp(self) -> Interval:
        """The interval of exp(x), by transforming the ends: perplexity beside nats, a ratio of perplexities beside a
        difference of nats. The standard error is by the delta method, sem exp(mean)."""
        mean = _exp(self.mean)
        return Interval(mean, self.sem * mean, _exp(self.low), _exp(self.high), self.n, self.episodes)


UNKNOWN = Interval(math.nan, math.nan, math.nan, math.nan)


def standard_errors(mean: float, sem: float) -> float:
    """How many standard errors a mean is from zero; 0 if it is exactly zero, nan for an unknown error."""
    if mean == 0:
        return 0.0
    return mean / sem if sem else math.copysign(math.inf, mean)


def interval_of(stat: Stat) -> Interval:
    """Student's t interval of the mean over one robot's windows, with one degree of freedom fewer than it has
    episodes."""
    return _around(stat, stat.clusters - 1)


def overall(stats: Iterable[Stat]) -> Interval:
    """The interval of the mean over robots, each counting equally (`stratified`).

    The robots are fixed: the interval is about other episodes of these robots, not about other robots. Degrees of
    freedom: `satterthwaite`'s, G - 1 for each robot's variance, over those with an error of their own.
    """
    stats = list(stats)
    freedom = satterthwaite((s.sem**2, s.clusters - 1) for s in stats if s.sem > 0)
    return _around(stratified(stats), freedom)


def satterthwaite(estimates: Iterable[tuple[float, float]]) -> float:
    """Degrees of freedom of a sum of (variance, its own degrees of freedom); infinite if nothing varies."""
    known = list(estimates)
    total, squares = add_up(v for v, _ in known), add_up(v**2 / df for v, df in known)
    return total**2 / squares if squares else math.inf


def nats_first(metrics: Iterable[str]) -> list[str]:
    """The metrics in the order in which tables show them."""
    metrics = list(metrics)
    return [m for m in NATS if m in metrics] + [m for m in metrics if m not in NATS]


def critical(df: float, level: float = LEVEL) -> float:
    """Standard errors on either side of a mean: the quantile of Student's t with `df` degrees of freedom."""
    return float(stdtrit(min(df, 1e9), (1 + level) / 2)) if df > 0 else math.nan


def _around(stat: Stat, df: float) -> Interval:
    half = critical(df) * stat.sem
    return Interval(stat.mean, stat.sem, stat.mean - half, stat.mean + half, stat.n, stat.episodes)


def _exp(x: float) -> float:
    """exp(x); infinite beyond what a float holds."""
    try:
        return math.exp(x)
    except OverflowError:
        return math.inf
