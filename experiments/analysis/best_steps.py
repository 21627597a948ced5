"""Every point of an axis at its best number of steps, chosen on episodes other than those on which it is judged.

Where data is scarce a model is best after fewer steps. Taking the lowest of several losses on the windows that judge it
would favour every point, and the noisiest most. So the episodes of every robot are halved: steps are chosen by the loss
on one half and judged on the other, both ways, and every window is judged once (two-fold cross-fitting).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.analysis.bootstrap import bootstrap_intervals, make_panel
from experiments.analysis.changes import CHANGED
from experiments.analysis.compare import lacks_numbers
from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.paired import NotComparable, agree, require_same_windows
from experiments.running.provenance import Provenance
from experiments.running.trial import training_of, trial_id
from experiments.sweeps.sweep import POINT, Sweep
from hma_jax.config.json import stable_hash
from hma_jax.evaluation.windows import WindowTable


@dataclass(frozen=True, kw_only=True)
class BestSteps:
    """A point judged at the number of steps chosen on other episodes; `chosen` lists numbers and how often each was
    chosen, 'steps x times'.
    `edge`: "edge" if the fewest or the most steps tried were chosen, so that other numbers may be better."""

    sweep: str
    x: float
    metric: str
    mean: float
    sem: float
    low: float
    high: float
    seeds: int
    n: int
    episodes: int
    chosen: str
    edge: str


def judge_at_best(
    sweeps: Sequence[Sweep], provenance: Provenance, windows: Mapping[str, WindowTable]
) -> list[BestSteps]:
    """Every point and seed with at least two trials that differ only in the number of steps, if the episodes can be
    halved and no loss is missing. Raises NotComparable."""
    rows = []
    for sweep in sweeps:
        if not (sweep.fittable and sweep.has_series) or sweep.interior_minimum:
            continue
        tables_by_steps: dict[float, dict[int, dict[int, WindowTable]]] = defaultdict(lambda: defaultdict(dict))
        trained = defaultdict(set)
        for point in (p for p in sweep.points if p.role == POINT and not p.scope):
            trained[point.x, point.trial.train.seed].add(stable_hash(training_of(point.trial)))
            table = windows.get(trial_id(point.trial, provenance))
            if table is not None and HELD_OUT_LOSS in table.metrics:
                tables_by_steps[point.x][point.trial.train.seed][point.trial.train.steps] = table
        for x, seeds in sorted(tables_by_steps.items()):
            several = {
                s: tables
                for s, tables in sorted(seeds.items())
                if len(tables) > 1 and len(trained[x, s]) == 1 and _can_choose(tables, sweep.scope)
            }
            if several:
                rows += _judge(sweep, x, several)
    return rows


def _judge(sweep: Sweep, x: float, seeds: Mapping[int, Mapping[int, WindowTable]]) -> list[BestSteps]:
    composed, chosen = {}, Counter()
    for seed, tables in seeds.items():
        composed[seed], steps = cross_fit(tables, sweep.scope)
        chosen.update(steps)
    listed = ", ".join(f"{steps} x {count}" for steps, count in sorted(chosen.items()))
    tried = {steps for tables in seeds.values() for steps in tables}
    edge = "edge" if {min(tried), max(tried)} & chosen.keys() else ""
    rows = []
    for metric in CHANGED:
        if not all(metric in t.metrics for t in composed.values()):
            continue
        panel = make_panel([composed], metric, sweep.scope)
        if lacks_numbers(metric, np.concatenate(panel.points)).any() or not panel.known.any():
            continue
        (interval,) = bootstrap_intervals(panel.rows(panel.known))
        rows.append(
            BestSteps(
                sweep=sweep.name, x=x, metric=metric, seeds=len(seeds), chosen=listed, edge=edge, **vars(interval)
            )
        )
    return rows


def cross_fit(tables: Mapping[int, WindowTable], robots: Sequence[str]) -> tuple[WindowTable, tuple[int, int]]:
    """({steps: table} as one table in which every window is judged at steps chosen without it, the steps chosen by each
    half of the episodes). The loss by which they are chosen is the mean over `robots` that the half has.

    Raises NotComparable unless all tables have the same windows, from at least two episodes.
    """
    first = next(iter(tables.values())).among(robots)
    matched = {}
    for steps, table in tables.items():
        own = table.among(robots)
        if not agree(first, own):
            require_same_windows(first, table)
        matched[steps] = own.aligned_to(first)
    half = halves(first)
    if not half.any():
        raise NotComparable(
            "steps are chosen on one half of the episodes and evaluated on the other, but there is only one episode; "
            "evaluate more"
        )
    chosen = []
    for h in (0, 1):
        losses = {steps: _mean_of_robots(t, half == h) for steps, t in matched.items()}
        chosen.append(min(sorted(losses), key=losses.__getitem__))
    shared = [m for m in first.metrics if all(m in t.metrics for t in matched.values())]
    by_other = [matched[chosen[1]], matched[chosen[0]]]  # windows of half 0 are judged at the steps chosen by half 1
    metrics = {m: np.where(half == 0, by_other[0].metrics[m], by_other[1].metrics[m]) for m in shared}
    return replace(first, metrics=metrics), (chosen[0], chosen[1])


def halves(table: WindowTable) -> np.ndarray:
    """int [n], 0 or 1: the episodes of each robot alternate, by number. Robots with a single episode alternate too, or
    half 1 would be empty if no robot has two."""
    half, alone = np.zeros(len(table), int), 0
    for robot in table.datasets:
        own = table.dataset == robot
        names, which = np.unique(table.episode[own], return_inverse=True)
        half[own] = which % 2 if len(names) > 1 else alone % 2
        alone += len(names) == 1
    return half


def _can_choose(tables: Mapping[int, WindowTable], robots: Sequence[str]) -> bool:
    """Whether the episodes can be halved, and every table has a loss for every window."""
    own = [table.among(robots) for table in tables.values()]
    return bool(halves(own[0]).any()) and not any(np.isnan(table.metrics[HELD_OUT_LOSS]).any() for table in own)


def _mean_of_robots(table: WindowTable, chosen: np.ndarray) -> float:
    """The mean loss of the windows `chosen`, bool [n], by robot, then over robots."""
    loss = table.metrics[HELD_OUT_LOSS]
    own = [chosen & (table.dataset == robot) for robot in table.datasets]
    return float(np.mean([loss[rows].mean() for rows in own if rows.any()]))
