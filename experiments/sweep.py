"""A sweep: trials along one axis of a study, and the trial that all sweeps share.

The three axes are declared in `scale_datasets`, `scale_trajectories` and `scale_width`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from experiments.provenance import Provenance
from experiments.study import Study
from experiments.trial import Trial, trial_id


@dataclass(frozen=True)
class Point:
    """A trial at position `x` of the axis. A control stands beside the curve, not on it."""

    x: int
    trial: Trial
    role: str = "point"  # or "control": trained on shuffled actions


@dataclass(frozen=True)
class Sweep:
    """`scope` names the datasets over which every point of the sweep is averaged."""

    name: str
    axis: str  # label with unit
    scope: tuple[str, ...]
    points: tuple[Point, ...]


def reference_trial(study: Study, seed: int) -> Trial:
    """All datasets, most trajectories, base model: the end of two axes and part of the third."""
    names = study.dataset_names()
    return Trial(
        datasets=names,
        max_trajectories=study.trajectory_counts[-1],
        evaluated=names,
        model=study.model,
        train=replace(study.train, seed=seed),
        eval=study.eval,
        tau=study.tau,
        measure_untrained=True,
    )


def make_sweep(
    study: Study,
    name: str,
    axis: str,
    scope: tuple[str, ...],
    values: Sequence[int],
    change: Callable[[Trial, int], Trial],
    reference_x: int,
) -> Sweep:
    """The sweep whose trial at x is `change(reference, x)`, for every seed, plus the control."""
    points = []
    for x in values:
        for seed in study.seeds:
            reference = reference_trial(study, seed)
            trial = reference if x == reference_x else change(replace(reference, measure_untrained=False), x)
            points.append(Point(x, trial))
    control = replace(reference_trial(study, study.seeds[0]), shuffle_actions=True, measure_untrained=False)
    points.append(Point(reference_x, control, role="control"))
    return Sweep(name, axis, scope, tuple(points))


def unique_trials(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, Trial]:
    """Every trial of `sweeps` once, by id, in the order in which they are worth running."""
    trials: dict[str, Trial] = {}
    for sweep in sweeps:
        for point in sweep.points:
            trials.setdefault(trial_id(point.trial, provenance), point.trial)
    return trials
