"""Which axes there are: the names of this folder's files, and files of the user's own.

An axis is a module with `plan(study) -> Sweep`. Those of the project are imported when they are asked for.
"""

from __future__ import annotations

import difflib
import importlib
import sys
import types
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from experiments.study import Study
from experiments.sweeps.sweep import Sweep, judge_less
from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import write_file

SCALING = ("datasets", "trajectories", "width")
"""The demonstration: what `hma study` runs, unless its preset says otherwise."""

DESIGNS = ("dilution", "transfer", "newcomers", "fewshot", "episodes", "compute", "horizon", "lr_horizon")
"""Those of a study that is to be believed (`DesignConfig`)."""

AXES = (*SCALING, "settings", "conditioning", "ladder", "lr", *DESIGNS)
"""Each is `experiments.sweeps.<name>`."""

KEPT = "axes"
"""The directory of a study that holds the files of its axes."""

Plan = Callable[[Study], Sweep]


def is_file(axis: str) -> bool:
    """Whether an axis is a file of the user's own, not one of the project's."""
    return axis.endswith(".py")


def join_axes(study: Study, root: Path, before: Sequence[str], axes: Sequence[str]) -> dict[str, str]:
    """{name: axis} of the axes that a study in `root` had `before`, whose files lie there, and of those asked for now:
    an axis takes the place of another one only if it has its name, whatever their files are called."""
    had = [str(root / axis) if is_file(axis) else axis for axis in before]
    return {
        sweep.name: axis
        for some in (had, axes)
        for axis, sweep in zip(some, plan_sweeps(study, some), strict=True)
    }


def keep_axes(axes: Mapping[str, str], root: Path) -> tuple[str, ...]:
    """The axes, {name: axis}, as a study in `root` remembers them: of a user's file a copy there, by the axis's name,
    so that its report can be drawn anywhere and its trials be planned again."""
    texts = {name: Path(axis).read_bytes() for name, axis in axes.items() if is_file(axis)}
    for name, text in texts.items():
        (root / KEPT).mkdir(exist_ok=True)
        write_file(root / KEPT / f"{name}.py", text)
    return tuple(f"{KEPT}/{name}.py" if name in texts else axis for name, axis in axes.items())


def find_axis(axis: str, root: Path = Path()) -> Plan:
    """The function that plans an axis, of its name or of a user's file, relative to `root`.

    Raises ConfigError without any.
    """
    if is_file(axis):
        return _load(root / axis)
    if axis not in AXES:
        near = difflib.get_close_matches(axis, AXES, n=1)
        meant = f"did you mean {near[0]}?" if near else f"known: {', '.join(AXES)}; or a file of your own, AXIS.py"
        raise ConfigError(f"no axis {axis!r}; {meant}")
    return importlib.import_module(f"experiments.sweeps.{axis}").plan


def plan_sweeps(study: Study, axes: Sequence[str], root: Path = Path()) -> list[Sweep]:
    """The sweeps along `axes`, of which files are relative to `root`. Raises ConfigError for an axis that is none, or
    that does not fit the study."""
    sweeps = [find_axis(axis, root)(study) for axis in axes]
    for axis, sweep in zip(axes, sweeps, strict=True):
        where = f"{axis}: plan(study)"
        require(isinstance(sweep, Sweep), f"{where} must return a Sweep, got {type(sweep).__name__}")
        require(bool(sweep.points), f"{where} returned a sweep without points")
        _require_distinct(sweep, where)
        if is_file(axis):
            require(sweep.name not in AXES, f"{where}: the name {sweep.name!r} is taken; choose another")
            require(
                sweep.name.isidentifier(),
                f"{where}: the name {sweep.name!r} becomes that of files; write it with letters, digits and _",
            )
    names = [sweep.name for sweep in sweeps]
    require(len(set(names)) == len(names), f"two axes have the same name: {', '.join(sorted(names))}")
    return [judge_less(study, sweep) for sweep in sweeps]


def _require_distinct(sweep: Sweep, where: str) -> None:
    """Raises ConfigError for two points that differ in nothing that rows tell apart: their spread would be taken for
    that of seeds."""
    places = Counter((p.x, p.series, p.role, p.trial.train.seed) for p in sweep.points)
    for (x, series, role, seed), count in places.items():
        at = ", ".join(filter(None, (f"{x:g}", series, role, f"seed {seed}")))
        require(count == 1, f"{where} returned {count} points at {at}; give each a position or a series of its own")


def _load(path: Path) -> Plan:
    """`plan` of a file, which is run. What it raises is its author's, and not caught.

    Compiled anew each time: Python's cached bytecode cannot tell a file from what it was in the same second.
    """
    require(path.is_file(), f"{path}: no such file; an axis is a Python file with plan(study) (docs/own_axis.md)")
    module = types.ModuleType(f"axis_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses of the file look themselves up there
    exec(compile(path.read_bytes(), path, "exec"), vars(module))
    plan = getattr(module, "plan", None)
    require(callable(plan), f"{path}: has no function plan(study) (docs/own_axis.md)")
    return plan
