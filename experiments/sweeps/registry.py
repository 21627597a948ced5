"""Which axes there are: the names of this folder's files, and files of the user's own.

An axis is a module with `plan(study) -> Sweep`. The project's axes are imported when they are asked for.
"""

from __future__ import annotations

import difflib
import importlib
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.running.trial import Trial
from experiments.study import SCALING, Study
from experiments.sweeps.sweep import CONTROL, POINT, STANDARD, Point, Sweep, limit_other_actions
from experiments.terminal.words import few
from experiments.user_input.user_file import find_function, naming_line
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.runtime.files import write_file

DESIGNS = ("dilution", "transfer", "newcomers", "fewshot", "episodes", "compute", "horizon", "lr_horizon")
"""The axes of a study that is meant as evidence (`DesignConfig`)."""

AXES = (*SCALING, "settings", "conditioning", "ladder", "lr", *DESIGNS)
"""Each is `experiments.sweeps.<name>`."""

PAGE = "docs/own_axis.md"

KEPT = "axes"
"""The directory of a study that holds the files of its axes."""

Plan = Callable[[Study], Sweep]


def is_file(axis: str) -> bool:
    """Whether an axis is a file of the user's own, not one of the project's."""
    return axis.endswith(".py")


def join_axes(study: Study, root: Path, before: Sequence[str], axes: Sequence[str]) -> dict[str, str]:
    """{name: axis} of the axes that a study in `root` had `before` (their files are in `root`) and of those asked for
    now. An axis replaces another of the same name, whatever their files are called."""
    had = [str(root / axis) if is_file(axis) else axis for axis in before]
    return {
        sweep.name: axis for some in (had, axes) for axis, sweep in zip(some, plan_sweeps(study, some), strict=True)
    }


def keep_axes(axes: Mapping[str, str], root: Path) -> tuple[str, ...]:
    """The `axes`, {name: axis}, as the record of a study in `root` lists them. A user's file is copied there, under the
    name of its axis, so that the report can be drawn and the trials planned again anywhere."""
    texts = {name: Path(axis).read_bytes() for name, axis in axes.items() if is_file(axis)}
    for name, text in texts.items():
        (root / KEPT).mkdir(exist_ok=True)
        write_file(root / KEPT / f"{name}.py", text)
    return tuple(f"{KEPT}/{name}.py" if name in texts else axis for name, axis in axes.items())


def find_axis(axis: str, root: Path = Path()) -> Plan:
    """The function that plans an axis, found by the axis's name or in a user's file (relative to `root`).

    Raises ConfigError if there is none, and for whatever the user's file raises, here or when it plans.
    """
    if is_file(axis):
        with naming_line(root / axis, PAGE):
            plan = find_function(root / axis, "plan(study)", "an axis is", PAGE)
        return naming_line(root / axis, PAGE)(plan)
    if axis not in AXES:
        near = difflib.get_close_matches(axis, AXES, n=1)
        meant = f"did you mean {near[0]}?" if near else f"known: {', '.join(AXES)}; or a file of your own, AXIS.py"
        raise ConfigError(f"no axis {axis!r}; {meant}")
    return importlib.import_module(f"experiments.sweeps.{axis}").plan


def plan_asked(study: Study, axes: Sequence[str]) -> list[Sweep]:
    """The sweeps along `axes` that are asked for now. Raises ConfigError as `plan_sweeps` does, for a file that plans
    different trials each time, and for a file without a point at its reference."""
    sweeps = plan_sweeps(study, axes)
    for axis, sweep in zip(axes, sweeps, strict=True):
        require(
            not is_file(axis) or plan_sweeps(study, (axis,)) == [sweep],
            f"{axis}: plan(study) returned another sweep when it was called again, so its trials would not be found when "
            "the study continues; give random numbers a fixed seed",
        )
        values = tuple(dict.fromkeys(p.x for p in sweep.points if p.role != CONTROL))
        require(
            sweep.reference_x is None or sweep.reference_x in values,
            f"{axis}: reference_x {sweep.reference_x} is not among the values {values}, so its control would have no trial "
            "beside it; add it",
        )
    return sweeps


def plan_sweeps(study: Study, axes: Sequence[str], root: Path = Path()) -> list[Sweep]:
    """The sweeps along `axes`; files are relative to `root`. Raises ConfigError for an axis that does not exist or does
    not fit the study."""
    sweeps: list[Sweep] = []
    for axis in axes:
        where, sweep = f"{axis}: plan(study)", find_axis(axis, root)(study)
        require(isinstance(sweep, Sweep), f"{where} must return a Sweep, got {type(sweep).__name__}")
        require(bool(sweep.points), f"{where} returned a sweep without points")
        if is_file(axis):
            sweep = _checked_trials(study, sweep, where)
        _require_distinct(sweep, where)
        if is_file(axis):
            require(sweep.name not in AXES, f"{where}: the name {sweep.name!r} is taken; choose another")
            require(
                sweep.name.isidentifier(),
                f"{where}: the name {sweep.name!r} is used in file names; use letters, digits and _",
            )
        sweeps.append(sweep)
    names = [sweep.name for sweep in sweeps]
    require(len(set(names)) == len(names), f"two axes have the same name: {', '.join(sorted(names))}")
    return [limit_other_actions(study, sweep) for sweep in sweeps]


def _checked_trials(study: Study, sweep: Sweep, where: str) -> Sweep:
    """A user's sweep with its trials as their processes read them: an int in place of a float becomes a float, since
    otherwise the same trial would have two names. Raises ConfigError for a field of a wrong type, for a point that is
    not a Point, for one whose trial would fail once it is trained, and for one whose value would belong to other
    robots, or to another position, than it says."""
    listed = isinstance(sweep.points, Sequence)
    require(listed, f"{where}: points must be a tuple of Point, got a {type(sweep.points).__name__}")
    _require_kinds(replace(sweep, points=()), f"{where}: the sweep")
    points: list[Point] = []
    for number, p in enumerate(sweep.points, start=1):
        of_trial = isinstance(p, Point) and isinstance(p.trial, Trial)
        what = type(p.trial if isinstance(p, Point) else p).__name__
        require(of_trial, f"{where}: point {number} must be a Point with a Trial, got a {what}")
        numbered = isinstance(p.x, int | float) and math.isfinite(p.x)
        require(
            numbered,
            f"{where}: position {p.x!r} of point {number} is not a number; for named positions use make_ablation",
        )
        named = not sweep.labels or p.x in range(len(sweep.labels))
        require(named, f"{where}: position {p.x:g} has no label; x counts into the {len(sweep.labels)} labels, from 0")
        known = (POINT, CONTROL, STANDARD)
        require(p.role in known, f"{where}: the role of point {number} must be one of {known}, got {p.role!r}")
        at = f"{where}: the trial at {p.x:g}"
        shuffled = p.role != CONTROL or p.trial.shuffle_actions
        require(shuffled, f"{at} is a control, but is not trained on shuffled actions; make it with control_of(trial)")
        read = _require_kinds(p, at)
        require(
            read == p, f"{at} has a setting of a wrong type: a list instead of a tuple, or a value that is not a number"
        )
        _require_trial(study, p.trial, p.scope or sweep.scope, at)
        points.append(replace(p, trial=read.trial))
    sweep = replace(sweep, points=tuple(points))
    drawn = {bool(p.series) for p in sweep.points if p.role != CONTROL}
    require(len(drawn) < 2, f"{where}: some points have a series and others have none, but a figure cannot show both")
    require(
        not (sweep.labels and sweep.has_series),
        f"{where} has labels and several series, but an axis with labels has one point per label and seed; put the "
        "series into the labels",
    )
    require(
        not sweep.labels or sweep.reference_x in range(len(sweep.labels)),
        f"{where}: reference_x is {sweep.reference_x}, but on an axis with labels it must be the position of the default, "
        f"from 0 to {len(sweep.labels) - 1}: the others are compared with it",
    )
    places: dict[tuple[str, str, str], float] = {}
    for p in sweep.points if not sweep.labels else ():
        trained = replace(p.trial, measure_untrained=False)  # of the reference only
        x = places.setdefault((p.series, p.role, stable_hash(to_dict(trained))), p.x)
        require(
            x == p.x,
            f"{where} has the same trial at {x:g} and {p.x:g}: nothing of it changes there, or the study's reference "
            "trial does not stand at reference_x",
        )
    return sweep


def _require_kinds(given: Any, where: str) -> Any:
    """The `given` value as a trial's process reads it. Raises ConfigError for a field of a wrong type."""
    try:
        return from_dict(type(given), json.loads(json.dumps(to_dict(given))))
    except (TypeError, ValueError) as error:  # ConfigError is a ValueError
        raise ConfigError(f"{where} has a setting of a wrong type ({error})") from error


def _require_trial(study: Study, trial: Trial, scope: Sequence[str], where: str) -> None:
    for one in trial.with_source():
        _require_fits(study, one, where)
    require(bool(scope), f"{where} is averaged over no robot; list those that it evaluates in `scope`")
    known = {name for one in trial.with_source() for name in one.datasets}
    for names, of, what in (
        (known, study.all_names(), "is trained on {}, which the study does not have"),
        (trial.evaluated, known, "evaluates {}, but is not trained on it; remove it from `evaluated`"),
        (scope, trial.evaluated, "does not evaluate {}, over which the axis averages; remove it from `scope`"),
        (trial.capped, trial.datasets, "caps trajectories of {}, but is not trained on it; remove it from `capped`"),
    ):
        without = [name for name in names if name not in of]
        require(not without, f"{where} {what.format(few(without))}")
    twice = [name for name, count in Counter(scope).items() if count > 1]
    require(
        not twice,
        f"{where} is averaged over {few(twice)} more than once, but robots count equally: list each once in `scope`",
    )
    most = trial.max_trajectories
    require(most is None or most >= 1, f"{where}: max_trajectories must be at least 1, or None for all, got {most}")
    require(
        most is not None or not trial.capped,
        f"{where} caps trajectories of {few(trial.capped)} at no number; set max_trajectories, or leave `capped` empty",
    )


def _require_fits(study: Study, trial: Trial, where: str) -> None:
    """Raises ConfigError for a trial with settings for which a study would be refused, and for one that would have to
    be judged on windows other than those that the study freezes."""
    own = {name: getattr(trial, name) for name in ("model", "eval", "tau", "rate", "weighed")}
    try:
        replace(study, train=replace(trial.train, seed=0), **own)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    for what, here, expected in (
        ("rate", trial.rate, study.rate),
        ("eval.windows_per_dataset", trial.eval.windows_per_dataset, study.eval.windows_per_dataset),
    ):
        require(
            here == expected,
            f"{where} has {what} {here}, and all trials of a study are judged on the same windows, which are frozen for "
            f"{expected}: compare two studies with --set {what}=... and an --out of their own",
        )


def _require_distinct(sweep: Sweep, where: str) -> None:
    """Raises ConfigError for two points that rows of results cannot distinguish: their spread would be taken for that
    of seeds."""
    places = Counter((p.x, p.series, p.role, p.trial.train.seed) for p in sweep.points)
    for (x, series, role, seed), count in places.items():
        at = ", ".join(filter(None, (f"{x:g}", series, role, f"seed {seed}")))
        require(count == 1, f"{where} returned {count} points at {at}; give each a position or a series of its own")
