"""A sweep: trials along one axis of a study, and the trial that most sweeps share.

Each axis is a file beside this one, and a line of `registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trial_id
from experiments.study import Study

POINT, CONTROL, STANDARD = "point", "control", "standard"
"""Roles of a trial: on the curve; beside it, trained on shuffled actions; on a curve without muP."""


@dataclass(frozen=True)
class Point:
    """A trial at position `x` of the axis."""

    x: float
    trial: Trial
    role: str = POINT
    series: str = ""  # the curve it lies on, in a sweep of several


@dataclass(frozen=True)
class Sweep:
    """`scope` names the datasets over which every point of the sweep is averaged."""

    name: str
    axis: str  # label with unit
    scope: tuple[str, ...]
    points: tuple[Point, ...]
    question: str = ""  # what it asks and how, for the page
    gain: str = ""  # what a model may gain from along it, for the headline
    title: str = ""  # of its section on the page; sweeps over one number share a section
    labels: tuple[str, ...] = ()  # an axis of names: x counts into these
    reference_x: int | None = None  # where the reference trial stands, if it does
    base: str = ""  # of several series, the one whose best x the others are to use

    @property
    def scaling(self) -> bool:
        """Whether it is one curve over a number."""
        return not self.labels and not self.base

    def label(self, x: float) -> str:
        """The name of `x`; '' on an axis of numbers."""
        return self.labels[int(x)] if self.labels else ""

    def remark(self, point: Point) -> str:
        """What the title of a point's trial does not say; '' where it says all."""
        if point.role == CONTROL or self.scaling:
            return ""
        if self.labels:
            return self.label(point.x)
        return f"{self.axis} {point.x:g}" + (", no muP" if point.role == STANDARD else "")


def reference_trial(study: Study, seed: int) -> Trial:
    """All datasets, most trajectories, base model: the end of two axes and part of others."""
    names = study.dataset_names()
    return Trial(
        datasets=names,
        max_trajectories=study.trajectory_counts[-1],
        evaluated=names,
        model=study.model,
        train=replace(study.train, seed=seed),
        eval=study.eval,
        tau=study.tau,
        rate=study.rate,
        weighed=study.weighed,
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
    *,
    question: str,
    gain: str,
    title: str = "",
    labels: tuple[str, ...] = (),
    seeds: tuple[int, ...] | None = None,
) -> Sweep:
    """The sweep whose trial at x is `change(reference, x)`, for every seed, plus the control.

    `seeds` are the study's unless given.
    """
    seeds = study.seeds if seeds is None else seeds
    points = []
    for x in values:
        for seed in seeds:
            reference = reference_trial(study, seed)
            trial = reference if x == reference_x else change(replace(reference, measure_untrained=False), x)
            points.append(Point(x, trial))
    control = replace(reference_trial(study, seeds[0]), shuffle_actions=True, measure_untrained=False)
    points.append(Point(reference_x, control, CONTROL))
    return Sweep(
        name, axis, scope, tuple(points),
        question=question, gain=gain, title=title, labels=labels, reference_x=reference_x,
    )  # fmt: skip


def make_ablation(
    study: Study,
    name: str,
    axis: str,
    variants: dict[str, Callable[[Trial], Trial]],
    default: str,
    *,
    question: str,
    gain: str,
    title: str,
) -> Sweep:
    """A sweep over named `variants` of the reference trial, which is the one named `default`.

    All datasets, the study's seeds for ablations.
    """
    labels = tuple(variants)
    return make_sweep(
        study, name, axis, study.dataset_names(), range(len(labels)),
        change=lambda trial, x: variants[labels[x]](trial),
        reference_x=labels.index(default), question=question, gain=gain, title=title, labels=labels,
        seeds=study.ablation_seeds,
    )  # fmt: skip


def unique_trials(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, Trial]:
    """Every trial of `sweeps` once, by id, in the order in which they are worth running."""
    trials: dict[str, Trial] = {}
    for sweep in sweeps:
        for point in sweep.points:
            trials.setdefault(trial_id(point.trial, provenance), point.trial)
    return trials


def titles(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, str]:
    """A line for every trial of `sweeps`, by id, that tells it from the others."""
    lines: dict[str, str] = {}
    for sweep in sweeps:
        for point in sweep.points:
            parts = filter(None, (point.trial.title, sweep.remark(point)))
            lines.setdefault(trial_id(point.trial, provenance), " · ".join(parts))
    return lines


def all_steps(sweeps: Sequence[Sweep]) -> str:
    """How many steps trials take, in words: '300 or 1,000'."""
    steps = sorted({point.trial.train.steps for sweep in sweeps for point in sweep.points})
    return " or ".join(f"{n:,}" for n in steps)
