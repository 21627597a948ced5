"""Where each of several curves is lowest, and what it costs to take another's best point.

For learning rates: how far the best rate of the base width is from the best rates of the other widths. Only points of
the grid are compared: an optimum between them is not interpolated. The lowest of several noisy losses is a choice with
an error of its own. Therefore the seeds decide which rates are as good as the best, and if there are several seeds, the
cost of a choice is judged on seeds that did not make it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

from scipy.special import stdtrit  # not scipy.stats, which takes most of a second to import

from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.rows import (
    OVERALL,
    TRAINING,
    TRAINING_LOSS,
    CurvePoint,
    Row,
    all_series,
    by_seed,
    curve,
    difference,
    of_sweep,
)
from experiments.running.ledger import DIVERGED, FINISHED
from experiments.sweeps.sweep import Sweep
from hma_jax.evaluation.sums import add_up

LOSSES = {HELD_OUT_LOSS: OVERALL, TRAINING_LOSS: TRAINING}
"""The metrics whose optima are taken, with scopes: nats per held-out token, and the training objective."""


@dataclass(frozen=True)
class Optimum:
    """The best point of one curve by one loss."""

    sweep: str
    metric: str
    role: str
    series: str
    x: float
    # "edge": what is as good reaches an end of what was tried, so that the best may lie beyond. "open": on one side of
    # the best no x is told to be worse, as one there has one seed in common with it or no result. Or "", also of a best
    # x with one seed (seed_sem is nan), which is told from nothing.
    edge: str
    loss: float
    seed_sem: float  # standard error over seeds, nan for one
    near_low: float  # the lowest and highest x that are `as_good` as the best; x itself with one seed
    near_high: float
    moved: float  # steps of the grid from the best x of the base series, downwards negative; nan without one
    transferred_x: float  # the best x of the base series in the same role; nan without one
    # By how much the loss of a seed is higher at the base's best x than at its own curve's, both chosen by the other
    # seeds where every point has several: the mean over seeds, and the lowest and highest of them. They are not
    # independent, so no standard error comes of them. inf if transferred_x diverged, nan if it has no result.
    penalty: float
    penalty_low: float
    penalty_high: float


def find_optima(rows: Sequence[Row], sweeps: Iterable[Sweep]) -> list[Optimum]:
    """One optimum for every curve with a finished trial, in sweeps that have a base series."""
    found = []
    for sweep in sweeps:
        if not sweep.base:
            continue
        own = of_sweep(rows, sweep.name)
        for metric, scope in LOSSES.items():
            for role, series in all_series(own, sweep.name).items():
                curves = {
                    s: candidates(curve(own, sweep.name, metric, role, scope, s), diverged(own, sweep.name, role, s))
                    for s in series
                }
                of_base = curves.get(sweep.base, [])
                found += [
                    _optimum(own, sweep.name, metric, role, s, points, best, of_base)
                    for s, points in curves.items()
                    if (best := lowest(points))
                ]
    return found


def diverged(rows: Iterable[Row], sweep: str, role: str, series: str) -> set[float]:
    """The x of a curve at which a seed diverged: no candidates, whatever the other seeds did."""
    return {r.x for r in _of(rows, sweep, role, series) if r.status == DIVERGED}


def ends(rows: Iterable[Row], sweep: str, role: str, series: str) -> set[float]:
    """The first and last x of a curve that have been tried: finished or diverged."""
    tried = sorted(r.x for r in _of(rows, sweep, role, series) if r.status in (FINISHED, DIVERGED))
    return set(tried[:1] + tried[-1:])


def candidates(points: Iterable[CurvePoint], excluded: Set[float]) -> list[CurvePoint]:
    """The points of a curve that have a finite mean and are not `excluded`."""
    return [p for p in points if p.x not in excluded and math.isfinite(p.mean)]


def lowest(points: Iterable[CurvePoint], excluded: Set[float] = frozenset()) -> CurvePoint | None:
    """The best of the `candidates` of a curve, if it has any."""
    return min(candidates(points, excluded), key=lambda p: p.mean, default=None)


def _optimum(
    rows: Sequence[Row],
    sweep: str,
    metric: str,
    role: str,
    series: str,
    points: Sequence[CurvePoint],
    best: CurvePoint,
    of_base: Sequence[CurvePoint],
) -> Optimum:
    """`points` and `of_base` are the candidates of the curve and of the base series."""
    transferred, moved, penalties = math.nan, math.nan, [math.nan]
    lost = diverged(rows, sweep, role, series)
    low, high = as_good(points, best, {r.x for r in _of(rows, sweep, role, series)})
    worse = told_worse(points, best) | lost
    between = any(x < best.x for x in worse) and any(x > best.x for x in worse)
    edge = "" if between or math.isnan(best.seed_sem) else "open"
    if ends(rows, sweep, role, series) & {low, high}:
        edge = "edge"
    if base := lowest(of_base):
        transferred, grid = base.x, sorted({r.x for r in rows if r.sweep == sweep})
        moved = grid.index(best.x) - grid.index(base.x)
        transferred_point = next((p for p in points if p.x == base.x), None)
        if base.x in lost:
            penalties = [math.inf]
        elif transferred_point:
            penalties = cross_validated_penalties(points, of_base) or by_seed(transferred_point, best) or [math.nan]
    return Optimum(
        sweep, metric, role, series, best.x, edge,
        loss=best.mean, seed_sem=best.seed_sem, near_low=low, near_high=high, moved=moved, transferred_x=transferred,
        penalty=add_up(penalties) / len(penalties), penalty_low=min(penalties), penalty_high=max(penalties),
    )  # fmt: skip


def as_good(points: Sequence[CurvePoint], best: CurvePoint, grid: set[float]) -> tuple[float, float]:
    """(lowest, highest x) of the candidates around `best` that seeds cannot distinguish from it: paired, 95 %,
    one-sided.

    The range ends before the first point that they do distinguish or that has no error, and before an x of the `grid`
    without a candidate.
    """
    known = {p.x for p in points if p.x == best.x or math.isfinite(difference(p, best)[1])}
    apart = grid - known | told_worse(points, best)
    below = max((x for x in apart if x < best.x), default=-math.inf)
    above = min((x for x in apart if x > best.x), default=math.inf)
    near = [p.x for p in points if below < p.x < above]
    return min(near), max(near)


def told_worse(points: Iterable[CurvePoint], best: CurvePoint) -> set[float]:
    """The x of the candidates that the seeds show to be worse than `best`: paired, 95 %, one-sided.

    For a point that scatters more than the curve's median point, the median error is used: if training is about to
    diverge, seeds scatter so much that no loss could be distinguished from the best. Two seeds in common are needed.
    """
    beside = {p.x: (*difference(p, best), len(by_seed(p, best))) for p in points if p.x != best.x}
    known = {x: of_seeds for x, of_seeds in beside.items() if math.isfinite(of_seeds[1])}
    usual = statistics.median([error for _, error, _ in known.values()] or [math.nan])
    return {x for x, (mean, error, seeds) in known.items() if mean > -stdtrit(seeds - 1, 0.05) * min(error, usual)}


def cross_validated_penalties(points: Sequence[CurvePoint], of_base: Sequence[CurvePoint]) -> list[float]:
    """What each seed of a curve loses with the base's best x instead of its own curve's, if both are chosen by the
    other seeds from the candidates of each curve. [] if fewer than two seeds are common to all candidates."""
    own = {p.x: p.seeds for p in points}
    base = {p.x: p.seeds for p in of_base if p.x in own}
    shared = set.intersection(*(set(seeds) for seeds in (*own.values(), *base.values()))) if base else set()
    if len(shared) < 2:
        return []
    penalties = []
    for seed in sorted(shared):
        others = shared - {seed}
        best, transferred = (min(c, key=lambda x, c=c: add_up(c[x][s] for s in others)) for c in (own, base))
        penalties.append(own[transferred][seed] - own[best][seed])
    return penalties


def _of(rows: Iterable[Row], sweep: str, role: str, series: str) -> list[Row]:
    return [r for r in rows if (r.sweep, r.role, r.series) == (sweep, role, series)]
