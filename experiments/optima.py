"""Where each of several curves is lowest, and what it costs to take another's best point.

For learning rates: how far off the rate that is best at the base width is at the others. Only
points of the grid are compared: an optimum between them is not interpolated. The lowest of several noisy losses is a
choice with an error of its own: which rates are as good as the best is told from the seeds, and what a choice costs is
judged on seeds that it was not made by.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scipy.special import stdtrit  # not scipy.stats, which takes most of a second to import

from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.rows import OVERALL, TRAINING, TRAINING_LOSS, CurvePoint, Row, all_series, curve, difference, of_sweep
from experiments.running.ledger import DIVERGED, FINISHED
from experiments.sweeps.sweep import Sweep
from hma_jax.evaluation.sums import add_up

LOSSES = {HELD_OUT_LOSS: OVERALL, TRAINING_LOSS: TRAINING}
"""What optima are taken of, with scopes: nats per held-out token, and the training objective."""


@dataclass(frozen=True)
class Optimum:
    """The best point of one curve by one loss."""

    sweep: str
    metric: str
    role: str
    series: str
    x: float
    edge: str  # "edge": the best is at an end of what was tried, so that it may lie beyond; or ""
    loss: float
    seed_sem: float  # over seeds, nan for one
    near_low: float  # the lowest and highest x that seeds do not tell from the best; x itself with one seed
    near_high: float
    moved: float  # steps of the grid from the best x of the base series, downwards negative; nan without one
    transferred_x: float  # the best x of the base series in the same role; nan without one
    # By how much the loss is higher there than at the best x, both chosen by the other seeds where every point has
    # several; inf if it diverged, nan if it has no result.
    penalty: float
    penalty_seed_sem: float


def find_optima(rows: Sequence[Row], sweeps: Iterable[Sweep]) -> list[Optimum]:
    """One for every curve with a finished trial, of sweeps that have a base series."""
    found = []
    for sweep in sweeps:
        if not sweep.base:
            continue
        own = of_sweep(rows, sweep.name)
        for metric, scope in LOSSES.items():
            for role, series in all_series(own, sweep.name).items():
                curves = {s: curve(own, sweep.name, metric, role, scope, s) for s in series}
                best = {s: lowest(points, diverged(own, sweep.name, role, s)) for s, points in curves.items()}
                base = best.get(sweep.base)
                of_base = curves.get(sweep.base, [])
                found += [
                    _optimum(own, sweep.name, metric, role, s, curves[s], point, base, of_base)
                    for s, point in best.items()
                    if point
                ]
    return found


def diverged(rows: Iterable[Row], sweep: str, role: str, series: str) -> set[float]:
    """The x of a curve at which a seed diverged: no candidates, whatever the other seeds did."""
    return {r.x for r in _of(rows, sweep, role, series) if r.status == DIVERGED}


def ends(rows: Iterable[Row], sweep: str, role: str, series: str) -> set[float]:
    """The first and last x of a curve that have been tried: finished or diverged."""
    tried = sorted(r.x for r in _of(rows, sweep, role, series) if r.status in (FINISHED, DIVERGED))
    return set(tried[:1] + tried[-1:])


def lowest(points: Sequence[CurvePoint], excluded: set[float]) -> CurvePoint | None:
    """The best point of a curve, if any has a finite mean and is not `excluded`."""
    candidates = [p for p in points if p.x not in excluded and math.isfinite(p.mean)]
    return min(candidates, key=lambda p: p.mean, default=None)


def _optimum(
    rows: Sequence[Row],
    sweep: str,
    metric: str,
    role: str,
    series: str,
    points: Sequence[CurvePoint],
    best: CurvePoint,
    base: CurvePoint | None,
    of_base: Sequence[CurvePoint],
) -> Optimum:
    transferred, moved, penalty, error = math.nan, math.nan, math.nan, math.nan
    diverged_x = diverged(rows, sweep, role, series)
    near = [p.x for p in points if p.x not in diverged_x and as_good(p, best)]
    if base:
        transferred, grid = base.x, sorted({r.x for r in rows if r.sweep == sweep})
        moved = grid.index(best.x) - grid.index(base.x)
        transferred_point = next((p for p in points if p.x == base.x), None)
        if base.x in diverged_x:
            penalty = math.inf
        elif transferred_point:
            penalty, error = cross_validated_penalty(points, of_base, diverged_x) or difference(transferred_point, best)
    return Optimum(
        sweep, metric, role, series, best.x,
        edge="edge" if best.x in ends(rows, sweep, role, series) else "",
        loss=best.mean, seed_sem=best.seed_sem, near_low=min(near), near_high=max(near), moved=moved,
        transferred_x=transferred, penalty=penalty, penalty_seed_sem=error,
    )  # fmt: skip


def as_good(point: CurvePoint, best: CurvePoint) -> bool:
    """Whether seeds do not tell it from the best, with 95 % and one side, paired."""
    if point.x == best.x:
        return True
    mean, error = difference(point, best)
    seeds = len(point.seeds.keys() & best.seeds.keys())
    return seeds > 1 and not mean > -stdtrit(seeds - 1, 0.05) * error


def cross_validated_penalty(
    points: Sequence[CurvePoint], of_base: Sequence[CurvePoint], diverged_x: set[float]
) -> tuple[float, float] | None:
    """(what a curve loses by the base's best x instead of its own, standard error over seeds): for each seed both are
    chosen by the other seeds. None with fewer than two seeds that every point of both curves has."""
    own, base = ({p.x: p.seeds for p in curve if p.x not in diverged_x} for curve in (points, of_base))
    base = {x: seeds for x, seeds in base.items() if x in own}
    shared = set.intersection(*(set(seeds) for seeds in (*own.values(), *base.values()))) if base else set()
    if len(shared) < 2:
        return None
    penalties = []
    for seed in sorted(shared):
        others = shared - {seed}
        best, transferred = (min(c, key=lambda x, c=c: add_up(c[x][s] for s in others)) for c in (own, base))
        penalties.append(own[transferred][seed] - own[best][seed])
    mean = add_up(penalties) / len(penalties)
    spread = add_up((d - mean) ** 2 for d in penalties) / (len(penalties) - 1)
    return mean, math.sqrt(spread / len(penalties))


def _of(rows: Iterable[Row], sweep: str, role: str, series: str) -> list[Row]:
    return [r for r in rows if (r.sweep, r.role, r.series) == (sweep, role, series)]
