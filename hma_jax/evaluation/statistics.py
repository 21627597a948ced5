"""Means with standard errors that are clustered by episode.

Windows of one episode share scene, task and lighting, so they are not independent. The deviations of an episode's
windows are therefore added up before they are squared. Reference: Cameron and Miller 2015, "A Practitioner's Guide to
Cluster-Robust Inference", for a regression on a constant.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hma_jax.config import require
from hma_jax.evaluation.metrics import group_means, official_perplexity
from hma_jax.evaluation.sums import add_up


@dataclass(frozen=True)
class Stat:
    """A mean over `n` values with its standard error (nan where it is unknown)."""

    mean: float
    sem: float
    n: int
    episodes: int = 0  # number of episodes that the values come from; 0: the values are independent

    @property
    def clusters(self) -> int:
        """The number of independent groups of values on which the error is based."""
        return self.episodes or self.n


class Estimate(NamedTuple):
    """A statistic of a dataset's windows, with its influence function: each window's effect on it, to first order.

    For another sample of windows the statistic would be about `value` + the mean of the `influence` of those windows.
    Estimates on the same windows can be subtracted: effects of windows that both share cancel.
    """

    value: float
    influence: np.ndarray  # [n], of mean 0

    def minus(self, other: Estimate) -> Estimate:
        with np.errstate(invalid="ignore"):  # the difference of two infinite perplexities is unknown
            return Estimate(self.value - other.value, self.influence - other.influence)


def estimate_mean(values: Any) -> Estimate:
    """The mean of a 1-D collection. Raises ConfigError for an empty one."""
    x = np.asarray(values, np.float64).ravel()
    require(len(x) > 0, "no values to average")
    mean = float(np.mean(x))
    return Estimate(mean, x - mean)


def estimate_perplexity(losses: Any, group: int) -> Estimate:
    """`official_perplexity` of windows in batches of `group`. Its influence is that of the corpus perplexity, because a
    dataset may hold too few batches to estimate an error from their scatter."""
    return _exponential(official_perplexity(*group_means(losses, group)), losses)


def estimate_corpus_perplexity(losses: Any) -> Estimate:
    """exp of the mean loss over all windows (infinite if it exceeds the range of a float); influence by the delta
    method."""
    with np.errstate(over="ignore"):
        return _exponential(float(np.exp(np.mean(np.asarray(losses, np.float64)))), losses)


def _exponential(value: float, losses: Any) -> Estimate:
    with np.errstate(invalid="ignore"):
        return Estimate(value, value * estimate_mean(losses).influence)


class Clusters(NamedTuple):
    """The episode of each of n windows, as a number from 0 to `count` - 1."""

    which: np.ndarray  # int [n]
    count: int


def clusters_of(episode_n: Any) -> Clusters:
    """The clusters of `episode_n`, episode numbers of any kind."""
    names, which = np.unique(np.asarray(episode_n), return_inverse=True)
    return Clusters(which, len(names))


def stat_of(estimate: Estimate, clusters: Clusters | None = None) -> Stat:
    """An estimate with its standard error; `clusters` holds the episode of each window.

    sem^2 = G / (G - 1) sum_g (sum_{i in g} u_i)^2 / n^2 over G episodes g, with influences u. G / (G - 1) is
    the correction for few episodes. nan with one episode, which gives no variance between episodes.
    Without `clusters` every value is an episode of its own, which is the usual standard error.
    """
    u, n = estimate.influence, len(estimate.influence)
    if clusters is not None:
        require(n == len(clusters.which), f"{n} values but {len(clusters.which)} episode numbers")
        u = np.bincount(clusters.which, weights=u)
    groups = len(u)
    sem = math.sqrt(groups / (groups - 1) * float(np.sum(u**2))) / n if groups > 1 else math.nan
    return Stat(estimate.value, sem, n, 0 if clusters is None else groups)


def mean_and_sem(values: Any, episode_n: Any = None) -> Stat:
    """Mean of a 1-D collection with its standard error (`stat_of`); `episode_n` is the episode of each value."""
    return stat_of(estimate_mean(values), None if episode_n is None else clusters_of(episode_n))


def stratified(stats: Iterable[Stat], weights: Iterable[float] | None = None) -> Stat:
    """Mean over datasets, all with equal weight or with `weights` w: sem = sqrt(sum w^2 sem^2) / sum w.

    The datasets are fixed, not a sample of possible datasets: only the episodes drawn within each contribute error. The
    error of a dataset with one episode cannot be estimated from it; its mean is assumed to scatter as one episode of
    the other datasets does on average. If none of these scatters at all, as with means that are exactly zero, the error
    stays unknown. `n` and `episodes` are sums over all datasets.
    """
    stats = list(stats)
    require(len(stats) > 0, "no datasets to average over")
    known = [s.sem**2 * s.clusters for s in stats if not math.isnan(s.sem)]  # variance of one episode
    typical = add_up(known) / len(known) if any(known) else math.nan
    squares = [typical / s.clusters if math.isnan(s.sem) else s.sem**2 for s in stats]
    parts = [1.0] * len(stats) if weights is None else list(weights)
    return Stat(
        mean=add_up(w * s.mean for w, s in zip(parts, stats, strict=True)) / add_up(parts),
        sem=math.sqrt(add_up(w**2 * square for w, square in zip(parts, squares, strict=True))) / add_up(parts),
        n=sum(s.n for s in stats),
        episodes=sum(s.episodes for s in stats),
    )
