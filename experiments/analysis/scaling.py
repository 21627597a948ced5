"""The scaling curves of a study, from its sweeps and every window's numbers, and their fits.

A sweep over one number is a curve, or one for each of its series. If its trials differ in width, the axis is not the
width but the number of trunk parameters: most of the other parameters belong to single robots. Trials that differ only
in width and steps, wherever in the study they are, make one surface over parameters and windows seen, for the joint
fit, and over parameters and training FLOPs, for the best size of a budget.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from experiments.analysis.fits import DRAWS, PowerFit, fit_power
from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.isoflop import IsoFlop, fit_isoflop
from experiments.analysis.measured import PRIOR, Measurements, NoLevel, Position, measure
from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trial_id
from experiments.sweeps.sweep import POINT, Point, Sweep
from hma_jax.config import ModelConfig
from hma_jax.config.json import identity_of, stable_hash
from hma_jax.evaluation.windows import WindowTable

TRUNK, WINDOWS, FLOPS = "trunk parameters", "windows seen", "training FLOPs"

OTHER_ROBOTS = "every seed is judged on other robots, how hard these are is taken out: intervals are over seeds alone"


@dataclass(frozen=True)
class Curve:
    """Trials on one or two axes; `positions` are those that the study plans."""

    name: str  # such as "width", with "-<series>" if there are several
    axes: tuple[str, ...]
    positions: tuple[Position, ...]

    def finished(self, windows: Mapping[str, WindowTable]) -> tuple[Position, ...]:
        return tuple(p for p in self.positions if p.trial in windows and HELD_OUT_LOSS in windows[p.trial].metrics)


@dataclass(frozen=True)
class CurveFit:
    """A curve, what was measured on it, and its fit."""

    curve: Curve
    measured: Measurements | None  # None: nothing is finished, or nothing can be compared
    fit: PowerFit


def curves_of(sweeps: Sequence[Sweep], provenance: Provenance) -> list[Curve]:
    """One curve for each series of every sweep along which a loss may fall as a power."""
    found = []
    for sweep in sweeps:
        if not sweep.fittable or sweep.interior_minimum:
            continue
        lines: dict[str, list[Point]] = defaultdict(list)
        for point in sweep.points:
            if point.role == POINT:
                lines[point.series].append(point)
        found += [_curve(sweep, series, points, provenance) for series, points in lines.items()]
    return found


def surface_of(sweeps: Sequence[Sweep], provenance: Provenance) -> Curve | None:
    """The largest group of a study's trials that differ only in width and steps, over TRUNK and WINDOWS; None if no
    group has two values of both."""
    groups: dict[str, dict[str, Trial]] = defaultdict(dict)
    for sweep in sweeps:
        for point in sweep.points:
            if point.role == POINT and sweep.fittable:
                groups[_all_but_size(point.trial)][trial_id(point.trial, provenance)] = point.trial

    def varies(group: dict[str, Trial], what: Callable[[Trial], float]) -> bool:
        return len({what(trial) for trial in group.values()}) > 1

    both = [g for g in groups.values() if varies(g, lambda t: t.model.width) and varies(g, _seen)]
    if not both:
        return None
    group = max(both, key=len)
    runs = _runs_of([((t.model.width, t.train.steps), t) for t in group.values()])
    positions = tuple(
        Position(id, run, t.train.seed, (float(trunk_parameters(t.model)), _seen(t)), t.evaluated)
        for (id, t), run in zip(group.items(), runs, strict=True)
    )
    return Curve("joint", (TRUNK, WINDOWS), positions)


def fit_curve(curve: Curve, windows: Mapping[str, WindowTable], draws: int = DRAWS, episodes: bool = True) -> CurveFit:
    """The power law of the finished trials of a curve. Raises ConfigError if they saw different windows."""
    positions = curve.finished(windows)
    if not positions:
        return CurveFit(
            curve, None, PowerFit(curve.axes, (), f"no finished trial has a {HELD_OUT_LOSS} of its windows")
        )
    try:
        measured = measure(curve.axes, positions, windows, HELD_OUT_LOSS)
    except NoLevel as error:  # until more trials have finished
        return CurveFit(curve, None, PowerFit(curve.axes, tuple(p.trial for p in positions), str(error)))
    fit = fit_power(measured, draws, episodes=episodes)
    if measured.panel is None and not fit.refused:
        fit = replace(fit, doubts=(*fit.doubts, OTHER_ROBOTS))
    return CurveFit(curve, measured, fit)


def fit_study(
    sweeps: Sequence[Sweep], provenance: Provenance, windows: Mapping[str, WindowTable], draws: int = DRAWS
) -> list[CurveFit]:
    """The fit of each curve, and the joint fit if there is a surface."""
    curves = curves_of(sweeps, provenance)
    surface = surface_of(sweeps, provenance)
    if surface is not None:
        curves.append(surface)
    return [fit_curve(curve, windows, draws) for curve in curves]


def fit_budgets(
    sweeps: Sequence[Sweep],
    provenance: Provenance,
    windows: Mapping[str, WindowTable],
    flops: Mapping[str, float],
    draws: int = DRAWS,
) -> IsoFlop | None:
    """The best size for a budget, from the surface's trials and the training `flops` of each; None without a
    surface."""
    surface = surface_of(sweeps, provenance)
    positions = [replace(p, x=(p.x[0], flops[p.trial])) for p in surface.finished(windows)] if surface else []
    if not positions:
        return None
    return fit_isoflop(measure((TRUNK, FLOPS), positions, windows, HELD_OUT_LOSS), draws=draws)


def _curve(sweep: Sweep, series: str, points: Sequence[Point], provenance: Provenance) -> Curve:
    """The curve of a series, over TRUNK if its trials differ in width."""
    wider = len({p.trial.model.width for p in points}) > 1

    def position(p: Point, run: str) -> Position:
        x = float(trunk_parameters(p.trial.model)) if wider else float(p.x)
        return Position(trial_id(p.trial, provenance), run, p.trial.train.seed, (x,), p.scope or sweep.scope)

    name = "-".join(filter(None, (sweep.name, series)))
    positions = tuple(map(position, points, _runs_of([(p.x, p.trial) for p in points])))
    return Curve(name, (TRUNK if wider else sweep.axis,), positions)


@lru_cache
def trunk_parameters(config: ModelConfig) -> int:
    """Parameters of the trunk that all robots share, counted on the declared model; no array is made."""
    from experiments.dry_run.cost import ONE_ROBOT
    from hma_jax.model.hma import declare_model

    leaves = declare_model(config, ONE_ROBOT).leaves()
    return sum(s.size for name, s in leaves.items() if name.startswith("trunk/") and s.embodiment_axis is None)


def _seen(trial: Trial) -> float:
    return float(trial.train.steps * trial.train.batch)


def _runs_of(points: Sequence[tuple[Hashable, Trial]]) -> list[str]:
    """The run of each (position, trial). Trials at one position are seeds of one run, although every seed may have its
    own robots; positions are branches of a run if the trials of their lowest seed differ only in steps."""
    lowest: dict[Hashable, Trial] = {}
    for position, trial in sorted(points, key=lambda point: point[1].train.seed):
        lowest.setdefault(position, trial)
    return [stable_hash(_without_steps(lowest[position])) for position, _ in points]


def _all_but_size(trial: Trial) -> str:
    """A value that is equal for trials that differ only in width, steps, seed, and the number of other actions under
    which they are judged (`sweeps.sweep.limit_other_actions`)."""
    values = _without_steps(trial)
    values["model"].pop("width")
    values["eval"].pop("other_actions")
    return stable_hash(values)


def _without_steps(trial: Trial) -> dict[str, Any]:
    # Added fields must not change the order in which runs are drawn; these two existed when runs got names.
    values: dict[str, Any] = {"capped": [], "source": None} | identity_of(trial)
    for name in ("steps", "seed"):
        values["train"].pop(name)
    values.pop("measure_untrained")
    return values


def noise_near(measured: Measurements, x: np.ndarray) -> tuple[float, float]:
    """(standard deviation over seeds of the logarithm of a trial's loss, its degrees of freedom) at the position with
    several seeds that is nearest to `x` [K]: it may grow along the axis. (nan, nan) if there is none."""
    count = np.bincount(measured.points)[measured.points]
    if not (count > 1).any():
        return float("nan"), float("nan")
    away = np.linalg.norm(np.log(measured.x) - np.log(x), axis=1)
    nearest = int(np.argmin(np.where(count > 1, away, np.inf)))
    # The variance joined with a position's own comes from the same seeds: it has no more freedom than they have.
    return float(measured.noise()[nearest]), float(min(count[nearest] - 1 + PRIOR, measured.freedom))
