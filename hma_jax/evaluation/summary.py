"""Means per dataset with their errors, and differences between two models, from tables of windows."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hma_jax.config import require
from hma_jax.evaluation.measures import OPTIONAL_METRICS
from hma_jax.evaluation.statistics import (
    Estimate,
    Stat,
    clusters_of,
    estimate_corpus_perplexity,
    estimate_mean,
    estimate_perplexity,
    mean_and_sem,
    stat_of,
    stratified,
)
from hma_jax.evaluation.windows import WindowTable


@dataclass(frozen=True)
class Summary:
    """Every metric of every dataset."""

    datasets: dict[str, dict[str, Stat]] = field(default_factory=dict)

    def over(self, names: Iterable[str]) -> dict[str, Stat]:
        """Each metric averaged, with equal weights, over those of the named datasets that have it."""
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
    """Means over the windows of each dataset, and the dataset's perplexities; errors are clustered by episode.

    Metrics that some windows lack (`OPTIONAL_METRICS`) are averaged over the windows that have them; a
    dataset where no window has one lacks the metric.
    `perplexity_group` is the number of windows per exp(mean loss) of the official perplexity.
    """
    found = {}
    for name in windows.datasets:
        own = windows.of(name)
        clusters = clusters_of(own.episode)
        found[name] = {m: stat_of(e, clusters) for m, e in _estimates(own, perplexity_group).items()}
        found[name] |= _of_some(own, own.metrics)
    return Summary(found)


def paired_difference(a: WindowTable, b: WindowTable, perplexity_group: int) -> Summary:
    """`a` minus `b`, window by window, on the datasets and metrics that both have.

    Paired by window: what makes a window hard for both models cancels. Errors are clustered by episode. Raises
    ConfigError if the two share no dataset, or if a dataset that they share has different windows.
    """
    shared = [name for name in a.datasets if name in b.datasets]
    require(len(shared) > 0, "two evaluations without a common dataset cannot be compared")
    found = {}
    for name in shared:
        own_a = a.of(name)
        own_b = b.of(name).aligned_to(own_a)
        estimates_a, estimates_b = (_estimates(x, perplexity_group) for x in (own_a, own_b))
        clusters = clusters_of(own_a.episode)
        found[name] = {
            m: stat_of(e.minus(estimates_b[m]), clusters) for m, e in estimates_a.items() if m in estimates_b
        }
        both = [m for m in OPTIONAL_METRICS if m in own_a.metrics and m in own_b.metrics]
        found[name] |= _of_some(own_a, {m: own_a.metrics[m] - own_b.metrics[m] for m in both})
    return Summary(found)


def _estimates(windows: WindowTable, perplexity_group: int) -> dict[str, Estimate]:
    """The estimates for one dataset: the mean of each metric, and for discrete tokens the perplexities."""
    own = {metric: column for metric, column in windows.metrics.items() if metric not in OPTIONAL_METRICS}
    estimates = {metric: estimate_mean(column) for metric, column in own.items()}
    if "cross_entropy" in windows.metrics:
        losses = windows.metrics["cross_entropy"]
        estimates["perplexity"] = estimate_perplexity(losses, perplexity_group)
        estimates["perplexity_corpus"] = estimate_corpus_perplexity(losses)
    return estimates


def _of_some(windows: WindowTable, columns: Mapping[str, np.ndarray]) -> dict[str, Stat]:
    """Means of the optional metrics in `columns`, over the windows that have them."""
    there = {metric: ~np.isnan(columns[metric]) for metric in OPTIONAL_METRICS if metric in columns}
    return {m: mean_and_sem(columns[m][some], windows.episode[some]) for m, some in there.items() if some.any()}
