"""The difference between the two ends of an axis, or of a variant from the default, window by window.

Trials of both sides were judged on the same windows, so what makes a window hard for both cancels (`compare`). If every
seed judges its own robots, each seed's difference is taken on these, and the error is over seeds. If a model lacks a
number that it should have for a metric, there is no difference: the page names the model (`report.validity`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.analysis.compare import Difference, Side, overall_difference
from experiments.analysis.intervals import Interval, critical
from experiments.analysis.paired import NoNumbers
from experiments.running.provenance import Provenance
from experiments.running.trial import trial_id
from experiments.sweeps.sweep import POINT, Point, Sweep
from hma_jax.evaluation.windows import WindowTable

CHANGED = ("cross_entropy", "action_nats", "delta_psnr")
OF_VARIANTS = ("cross_entropy", "diffusion_loss", "delta_psnr", "action_error")


@dataclass(frozen=True, kw_only=True)
class Change:
    """The mean at `last` minus that at `first`, over robots, with its interval; `seeds`: those that both ends have."""

    sweep: str
    series: str
    first: float
    last: float
    metric: str
    mean: float
    sem: float
    low: float
    high: float
    errors: float  # distance from zero in standard errors
    seeds: int
    n: int
    episodes: int


def find_changes(sweeps: Sequence[Sweep], provenance: Provenance, windows: Mapping[str, WindowTable]) -> list[Change]:
    """The change of every metric along each axis of numbers, from its smallest to its largest finished x. Raises
    NotComparable."""
    found = []
    for sweep in (s for s in sweeps if s.fittable):
        points = [p for p in sweep.points if p.role == POINT]
        for series in dict.fromkeys(p.series for p in points):
            trials = finished_by_x((p for p in points if p.series == series), provenance, windows)
            if len(trials) > 1:
                found += _changes(sweep, series, {x: trials[x] for x in (min(trials), max(trials))}, CHANGED)
    return found


def find_differences(
    sweeps: Sequence[Sweep], provenance: Provenance, windows: Mapping[str, WindowTable]
) -> list[Change]:
    """The change of every metric from an axis's default variant (`first`) to each other variant (`last`). Raises
    NotComparable."""
    found = []
    for sweep in (s for s in sweeps if s.labels):
        own = [p for p in sweep.points if p.role == POINT and not p.series]
        trials = finished_by_x(own, provenance, windows)
        for x in sorted(trials.keys() - {sweep.reference_x}):
            found += _changes(sweep, "", {at: trials.get(at, {}) for at in (sweep.reference_x, x)}, OF_VARIANTS)
    return found


Ends = Mapping[float, Mapping[int, tuple[Point, WindowTable]]]


def finished_by_x(points: Iterable[Point], provenance: Provenance, windows: Mapping[str, WindowTable]) -> Ends:
    """{x: {seed: (the point, its windows)}} of the `points` of one curve whose trials are finished."""
    trials: dict[float, dict[int, tuple[Point, WindowTable]]] = defaultdict(dict)
    for point in points:
        if (table := windows.get(trial_id(point.trial, provenance))) is not None:
            trials[point.x][point.trial.train.seed] = point, table
    return dict(trials)


def _changes(sweep: Sweep, series: str, ends: Ends, metrics: Sequence[str]) -> list[Change]:
    """The change of each of `metrics` between two ends, of which the first is the one to compare with; none unless they
    share a seed."""
    if not set.intersection(*map(set, ends.values())):
        return []
    return [c for metric in metrics if (c := _change(sweep, series, ends, metric)) is not None]


def _change(sweep: Sweep, series: str, ends: Ends, metric: str) -> Change | None:
    first, last = ends
    scopes = {seed: point.scope or sweep.scope for seed, (point, _) in ends[last].items()}
    sides = [Side(f"{sweep.axis} {x:g}", {s: table for s, (_, table) in ends[x].items()}, "") for x in (last, first)]
    try:
        if len(set(scopes.values())) == 1:
            d = overall_difference(*sides, metric, next(iter(scopes.values())))
        else:
            d = _over_seeds(*sides, metric, scopes)
    except NoNumbers:
        return None
    if d is None:
        return None
    return Change(
        sweep=sweep.name, series=series, first=first, last=last, metric=metric, errors=d.errors, seeds=d.seeds,
        **vars(d.interval),
    )  # fmt: skip


def _over_seeds(a: Side, b: Side, metric: str, scopes: Mapping[int, Sequence[str]]) -> Difference | None:
    """The mean of every seed's difference on its own robots; the seeds being independent, their spread is its error."""
    each = []
    for seed, robots in scopes.items():
        if seed in a.seeds and seed in b.seeds:
            sides = (Side(side.name, {seed: side.seeds[seed]}, "") for side in (a, b))
            each.append(overall_difference(*sides, metric, robots))
    known = [d for d in each if d is not None]
    if not known:
        return None
    if len(known) == 1:
        return known[0]
    means = np.array([d.mean for d in known])
    mean, sem = float(means.mean()), float(means.std(ddof=1) / math.sqrt(len(means)))
    half = critical(len(means) - 1) * sem
    at_a, at_b = (float(np.mean([getattr(d, side) for d in known])) for side in "ab")
    windows, episodes = sum(d.n for d in known), sum(d.episodes for d in known)
    interval = Interval(mean, sem, mean - half, mean + half, windows, episodes)
    return Difference(
        scope=known[0].scope, metric=metric, a=at_a, b=at_b, errors=interval.errors, seeds=len(known), **vars(interval)
    )
