"""Means per dataset with their errors, and differences between two models, from tables of windows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hma_jax.config import require
from hma_jax.evaluation.controllability import OPTIONAL
from hma_jax.evaluation.statistics import (
    Estimate,
    Stat,
    estimate_corpus_perplexity,
    estimate_mean,
    estimate_perplexity,
    stat_of,
    stratified,
)
from hma_jax.evaluation.windows import WindowTable


@dataclass(frozen=True)
class Summary:
    """Every metric of every dataset."""

    datasets: dict[str, dict[str, Stat]] = field(default_factory=dict)

    def over(self, names: Iterable[str]) -> dict[str, Stat]:
        """Each metric averaged over those of the named datasets that have it, all counting equally."""
        chosen = [self.datasets[name] for name in names]
        require(len(chosen) > 0, "no datasets to average an evaluation over")
        metrics = dict.fromkeys(metric for d in chosen for metric in d)
        return {metric: stratified(d[metric] for d in chosen if metric in d) for metric in metrics}

    @property
    def overall(self) -> dict[str, Stat]:
        return self.over(self.datasets)

    def to_dict(self) -> dict[str, Any]:
        return {n: {m: dataclasses.asdict(s) for m, s in d.items()} for n, d in self.datasets.items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Summary:
        return cls({n: {m: Stat(**s) for m, s in d.items()} for n, d in values.items()})


def summarise(windows: WindowTable, perplexity_group: int) -> Summary:
    """Means over the windows of each dataset, and its perplexities; errors clustered by episode.

    Of what some windows have not (`controllability.OPTIONAL`) the mean is over those that have it; a dataset
    without any has no such metric.
    `perplexity_group` is the number of windows per exp(mean loss) of the official perplexity.
    """
    found = {}
    for name in windows.datasets:
        own = windows.of(name)
        found[name] = {m: stat_of(e, own.episode) for m, e in _estimates(own, perplexity_group).items()}
        found[name] |= _of_some(own, own.metrics)
    return Summary(found)


def means_and_errors(windows: WindowTable, perplexity_group: int) -> dict[str, dict[str, tuple[float, float]]]:
    """{dataset: {metric: (mean, standard error)}} that `summarise` finds, to rounding: errors of all metrics of a dataset
    are taken together, in a third of the time."""
    found = {}
    for name in windows.datasets:
        own = windows.of(name)
        there = _there(own.metrics)
        whole = _estimates(own, perplexity_group)
        whole |= {m: estimate_mean(own.metrics[m]) for m, known in there.items() if known.all()}
        _, episode = np.unique(own.episode, return_inverse=True)
        groups = int(episode.max()) + 1
        few = groups / (groups - 1) if groups > 1 else math.nan
        with np.errstate(invalid="ignore"):  # of an infinite perplexity nothing is known
            sums = np.stack([e.influence for e in whole.values()]) @ (episode[:, None] == np.arange(groups))
            sems = np.sqrt(few * (sums**2).sum(1)) / len(own)
        found[name] = {m: (e.value, float(sem)) for (m, e), sem in zip(whole.items(), sems, strict=True)}
        some = {m: own.metrics[m] for m, known in there.items() if not known.all()}
        found[name] |= {m: (stat.mean, stat.sem) for m, stat in _of_some(own, some).items()}
    return found


def paired_difference(a: WindowTable, b: WindowTable, perplexity_group: int) -> Summary:
    """`a` minus `b`, window by window, on the datasets and metrics that both have.

    What makes a window hard for both models cancels, so that the error is that of the difference and
    not of the two means; it is clustered by episode. Raises ConfigError if they share no dataset, or if
    the windows of one that they share are not the same.
    """
    shared = [name for name in a.datasets if name in b.datasets]
    require(len(shared) > 0, "two evaluations without a common dataset cannot be compared")
    found = {}
    for name in shared:
        mine = a.of(name)
        other = b.of(name).matched_to(mine)
        ours, theirs = (_estimates(x, perplexity_group) for x in (mine, other))
        found[name] = {m: stat_of(e.minus(theirs[m]), mine.episode) for m, e in ours.items() if m in theirs}
        both = [m for m in OPTIONAL if m in mine.metrics and m in other.metrics]
        found[name] |= _of_some(mine, {m: mine.metrics[m] - other.metrics[m] for m in both})
    return Summary(found)


def _estimates(windows: WindowTable, perplexity_group: int) -> dict[str, Estimate]:
    """Of one dataset: the mean of each metric, and for discrete tokens the perplexities."""
    own = {metric: column for metric, column in windows.metrics.items() if metric not in OPTIONAL}
    estimates = {metric: estimate_mean(column) for metric, column in own.items()}
    if "cross_entropy" in windows.metrics:
        losses = windows.metrics["cross_entropy"]
        estimates["perplexity"] = estimate_perplexity(losses, perplexity_group)
        estimates["perplexity_corpus"] = estimate_corpus_perplexity(losses)
    return estimates


def _of_some(windows: WindowTable, columns: Mapping[str, np.ndarray]) -> dict[str, Stat]:
    """Means of the optional metrics in `columns`, of the windows that have them."""
    there = _there(columns)
    return {m: stat_of(estimate_mean(columns[m][known]), windows.episode[known]) for m, known in there.items()}


def _there(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Which windows have each of the optional metrics that any has."""
    known = {metric: ~np.isnan(columns[metric]) for metric in OPTIONAL if metric in columns}
    return {metric: there for metric, there in known.items() if there.any()}
