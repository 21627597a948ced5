"""What tests of committed findings share: pages, rows, and robots of the studies."""

import csv
import functools
from dataclasses import replace
from pathlib import Path

from data_pipelines.suite.embodiments import TRAINED
from experiments.analysis.compare import Difference, Side, overall_difference
from experiments.analysis.rows import Row, read_rows
from experiments.report.robots import Robot, robots_of
from experiments.running.trial import trial_id
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import POINT
from hma_jax.evaluation.windows import FILE as WINDOWS
from hma_jax.evaluation.windows import WindowTable

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"


def findings(study: str = "cpu-full") -> str:
    return (RESULTS / study / "findings.md").read_text()


@functools.cache
def rows_of(study: str = "cpu-full") -> tuple[Row, ...]:
    """The rows of its tables, which most tests need and which take seconds to read."""
    return tuple(read_rows(Workspace(RESULTS / study)))


def in_place_rows(name: str) -> list[dict[str, str]]:
    """Where things stand at the end of windows of one model."""
    with open(RESULTS / "in_place" / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def readme() -> str:
    """On one line."""
    return " ".join((ROOT / "README.md").read_text().split())


ACTING = {e.name for e in TRAINED if not e.video_only}
"""Robots that are trained with actions."""


@functools.cache
def robots_at(
    study: str, axis: str, role: str = POINT, seed: int | None = None, at: float | None = None
) -> dict[float, tuple[list[Robot], int]]:
    """{x: (every robot, from every window's numbers, trials)} of the points of `role` of an axis of a study, of one
    `seed` or all, `at` one x or all."""
    workspace = Workspace(RESULTS / study)
    record = load_record(workspace)
    (sweep,) = plan_sweeps(record.study, (axis,))
    own = (p for p in sweep.points if p.role == role and seed in (None, p.trial.train.seed) and at in (None, p.x))
    points = tuple(replace(p, role=POINT) for p in own)
    found = {}
    for x in sorted({p.x for p in points}):
        ids = [trial_id(p.trial, record.provenance) for p in points if p.x == x]
        windows = {id: WindowTable.load(workspace.trials / id / WINDOWS) for id in ids}
        at_x = replace(sweep, points=points, reference_x=x)
        found[x] = robots_of([], at_x, record.provenance, windows), len(ids)
    return found


@functools.cache
def variants(study: str, axis: str) -> tuple[dict[str, Side], tuple[str, ...]]:
    """({name: its trials}, the robots that are judged) of an axis of names."""
    workspace = Workspace(RESULTS / study)
    record = load_record(workspace)
    (sweep,) = plan_sweeps(record.study, (axis,))
    found: dict[str, dict[int, WindowTable]] = {}
    for p in (p for p in sweep.points if p.role == POINT):
        table = WindowTable.load(workspace.trials / trial_id(p.trial, record.provenance) / WINDOWS)
        found.setdefault(sweep.label(p.x), {})[p.trial.train.seed] = table
    return {name: Side(name, seeds, "") for name, seeds in found.items()}, sweep.scope


def paired(study: str, axis: str, a: str, b: str, metric: str) -> Difference:
    """a minus b, window by window, with its error over seeds and episodes."""
    sides, robots = variants(study, axis)
    return overall_difference(sides[a], sides[b], metric, robots)


def counts(robots: list[Robot]) -> list[int]:
    """How many are ahead of copying; of those that act, action-nats beyond 3 standard errors, delta PSNR beyond 2."""
    follow = [r.follows for r in robots if r.name in ACTING]
    beyond = [sum(f[metric].errors > n for f in follow) for metric, n in (("action_nats", 3), ("delta_psnr", 2))]
    return [sum(r.ahead > 0 for r in robots), *beyond]
