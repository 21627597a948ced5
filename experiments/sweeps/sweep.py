"""A sweep: trials along one axis of a study, and the trial that most sweeps share.

Each axis is a file beside this one and a line in `registry`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, training_of, trial_id
from experiments.study import Study
from experiments.terminal.words import counted
from hma_jax.config import require
from hma_jax.config.json import diff, stable_hash

POINT, CONTROL, STANDARD = "point", "control", "standard"
"""Roles of a trial: on the curve; beside it, trained on shuffled actions; on a curve without muP."""


@dataclass(frozen=True)
class Point:
    """A trial at position `x` of the axis."""

    x: float
    trial: Trial
    role: str = POINT
    series: str = ""  # the curve it lies on, if the sweep has several
    scope: tuple[str, ...] = ()  # robots judged here, if they differ between seeds; (): the sweep's


@dataclass(frozen=True)
class Sweep:
    """`scope` names the datasets over which every point of the sweep is averaged."""

    name: str
    axis: str  # label with unit
    scope: tuple[str, ...]
    points: tuple[Point, ...]
    question: str = ""  # what the sweep asks and how, for the page
    gain: str = ""  # what a model may gain from along the axis, for the headline
    title: str = ""  # title of its section on the page; sweeps over one number share a section
    labels: tuple[str, ...] = ()  # an axis of names: x counts into these
    reference_x: float | None = None  # of the default: the reference trial, or the trial that replaces it on this axis
    base: str = ""  # the series, of several, whose best x is transferred to the others
    interior_minimum: bool = False  # the lowest loss is expected inside the axis, not at an end: no power law

    @property
    def has_series(self) -> bool:
        """Whether it has several curves."""
        return any(point.series for point in self.points)

    @property
    def single_curve(self) -> bool:
        """Whether it is one curve over a number."""
        return not self.labels and not self.has_series

    @property
    def fittable(self) -> bool:
        """Whether x is a quantity, so that a power law over it can be fitted, on one curve or several."""
        return not self.labels and not self.base

    @property
    def beside_controls(self) -> str:
        """The series, of several, whose trials the controls repeat on shuffled actions; '' unless it is exactly one."""
        controls = [p.trial for p in self.points if p.role == CONTROL]
        found = {p.series for p in self.points if p.role == POINT and control_of(p.trial) in controls}
        return found.pop() if len(found) == 1 else ""

    @property
    def robots_vary(self) -> bool:
        """Whether every seed is judged on its own robots, so that the windows differ between seeds."""
        places = {(p.x, p.series, p.role) for p in self.points}
        return len({(p.x, p.series, p.role, p.scope) for p in self.points}) > len(places)

    def label(self, x: float) -> str:
        """The name of `x`; '' on an axis of numbers."""
        return self.labels[int(x)] if self.labels else ""

    def remark(self, point: Point) -> str:
        """What the title of a point's trial does not say; '' if it says everything."""
        if point.role == CONTROL or self.single_curve:
            return ""
        if self.labels:
            return self.label(point.x)
        if not self.base:
            return point.series
        return f"{self.axis} {point.x:g}" + (", no muP" if point.role == STANDARD else "")


def reference_trial(study: Study, seed: int, steps: int | None = None) -> Trial:
    """All datasets, most trajectories, base model: the end of two axes and part of others. `steps`: a number other than
    the study's, for a branch of the same run. With the study's own, the model is also judged before its first step."""
    names = study.dataset_names()
    train = study.train if steps is None else replace(study.train, steps=steps)
    return Trial(
        datasets=names,
        max_trajectories=study.trajectory_counts[-1],
        evaluated=names,
        model=study.model,
        train=replace(train, seed=seed),
        eval=study.eval,
        tau=study.tau,
        rate=study.rate,
        weighed=study.weighed,
        measure_untrained=train.steps == study.train.steps,
    )


def control_of(trial: Trial) -> Trial:
    """The same trial, trained on the actions of other episodes, so it cannot learn what actions do."""
    return replace(trial, shuffle_actions=True, measure_untrained=False)


def limit_other_actions(study: Study, sweep: Sweep) -> Sweep:
    """The sweep with fewer other action sequences per evaluation. Retrieval among many sequences is half of an
    evaluation's cost, so it is measured only for the reference, at all its numbers of steps, and for its control. All
    other trials are judged under `designs.other_actions` sequences, which is enough for action-nats."""
    few = study.designs.other_actions
    if few is None:
        return sweep
    references = [reference_trial(study, seed) for seed in study.seeds]
    whole = {stable_hash(training_of(t)) for trial in references for t in (trial, control_of(trial))}

    def judged(trial: Trial) -> Trial:
        if trial.source:
            trial = replace(trial, source=judged(trial.source))
        if trial.eval != study.eval or stable_hash(training_of(trial)) in whole:
            return trial
        return replace(trial, eval=replace(trial.eval, other_actions=min(few, trial.eval.other_actions)))

    return replace(sweep, points=tuple(replace(point, trial=judged(point.trial)) for point in sweep.points))


def make_sweep(
    study: Study,
    name: str,
    axis: str,
    scope: tuple[str, ...],
    values: Sequence[float],
    change: Callable[[Trial, Any], Trial],
    reference_x: float,
    *,
    question: str,
    gain: str,
    title: str = "",
    labels: tuple[str, ...] = (),
    seeds: tuple[int, ...] | None = None,
    steps: int | None = None,
) -> Sweep:
    """The sweep whose trial at x is `change(reference, x)`, for every seed, plus controls: at the reference, and at the
    ends of a numbered axis if the study sets `end_controls`.

    `seeds` are the study's unless given; `steps` are those of every trial. Raises ConfigError without `values` or
    seeds, and if the study's reference trial is not at `reference_x`: there `change` must leave it as it is, except for
    the robots that it is judged on.
    """
    require(len(values) > 0, f"axis {name}: values is empty, so only its control would run; give it positions")
    values = [x.item() if isinstance(x, np.generic) else x for x in values]  # numpy's numbers are no JSON
    reference_x = next((x for x in values if x == reference_x), reference_x)
    seeds = study.seeds if seeds is None else seeds
    require(len(seeds) > 0, f"axis {name}: seeds is empty; give at least one, or leave it out for the study's")
    unchanged = reference_trial(study, seeds[0], steps)
    changed = change(unchanged, reference_x)
    require(isinstance(changed, Trial), f"axis {name}: change must return a trial, but returned {changed!r}")
    lines = diff(unchanged, replace(changed, evaluated=unchanged.evaluated))
    require(
        not lines,
        f"axis {name}: the reference trial of this study does not stand at reference_x {reference_x}, where it would be "
        f"changed ({'; '.join(lines)}); give the position that it has",
    )

    def trial(x: float, seed: int) -> Trial:
        reference = reference_trial(study, seed, steps)
        return reference if x == reference_x else change(replace(reference, measure_untrained=False), x)

    points = [Point(x, trial(x, seed)) for x in values for seed in seeds]
    ends = {min(values), max(values)} if study.designs.end_controls and not labels else set()
    points += [Point(x, control_of(trial(x, seeds[0])), CONTROL) for x in sorted({reference_x, *ends})]
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
        seeds=study.ablation_seeds, steps=study.designs.ablation_steps,
    )  # fmt: skip


def unique_trials(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, Trial]:
    """Every trial of `sweeps` once, by id, in the order in which they are worth running."""
    trials: dict[str, Trial] = {}
    for sweep in sweeps:
        for point in sweep.points:
            for trial in point.trial.with_source():
                trials.setdefault(trial_id(trial, provenance), trial)
    return trials


def all_judged(sweeps: Sequence[Sweep]) -> set[str]:
    """Every dataset that a point of `sweeps` is averaged over."""
    return {name for sweep in sweeps for point in sweep.points for name in point.scope or sweep.scope}


def titles(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, str]:
    """A line for every trial of `sweeps`, by id, that distinguishes it from the others."""
    lines: dict[str, str] = {}
    places: dict[str, str] = {}  # on an axis of numbers, off the reference
    several = len({trial.train.steps for trial in unique_trials(sweeps, provenance).values()}) > 1

    def add(trial: Trial, remark: str) -> None:
        steps = counted(trial.train.steps, "step") if several else ""
        lines.setdefault(trial_id(trial, provenance), " · ".join(filter(None, (trial.title, steps, remark))))

    for sweep in sweeps:
        for point in sweep.points:
            add(point.trial, sweep.remark(point))
            if sweep.single_curve and point.x != sweep.reference_x:
                places.setdefault(trial_id(point.trial, provenance), f"{sweep.axis} {point.x:g}")
    for sweep in sweeps:
        for point in sweep.points:
            for source in point.trial.with_source()[:-1]:
                add(source, "")
    # An axis may vary something that no trial's own title shows.
    alike = {line for line, count in Counter(lines.values()).items() if count > 1}
    return {id: f"{line} · {places[id]}" if line in alike and id in places else line for id, line in lines.items()}


def all_steps(sweeps: Sequence[Sweep]) -> str:
    """How many steps trials take, in words: '300 or 1,000 steps'; for more than three numbers, '300 to 1,000 steps'."""
    *fewer, most = sorted({point.trial.train.steps for sweep in sweeps for point in sweep.points})
    if len(fewer) > 2:
        return f"{fewer[0]:,} to {counted(most, 'step')}"
    return " or ".join([*(f"{n:,}" for n in fewer), counted(most, "step")])
