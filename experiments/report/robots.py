"""The numbers of one configuration robot by robot, the most controllable first."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from experiments.analysis.controllability import Controllability, controllability, count_following, expected_by_chance
from experiments.analysis.rows import OVERALL, CurvePoint, Row, curve, of_sweep
from experiments.data_size import read_data
from experiments.report.pieces import pm, table
from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trial_id
from experiments.sweeps.sweep import POINT, Sweep
from hma_jax.evaluation.measures import METRICS
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.evaluation.windows import WindowTable

COLUMNS = (
    "perplexity", "diffusion_loss", "accuracy", "psnr", "psnr_copy", "ssim", "lpips", "lpips_copy", "action_error",
    "action_error_of_mean",
)  # fmt: skip
FOLLOWS = ("action_nats", "retrieval", "delta_psnr", "counterfactual_gain")
ORDER = ("action_nats", "delta_psnr")
"""Controllability: by the first that was measured."""


@dataclass(frozen=True)
class Robot:
    """One robot's numbers over the trials of one configuration, of all seeds."""

    name: str
    errors: float  # standard errors of ORDER from zero; nan if it was not measured
    ahead: float  # PSNR in dB above copying the last given frame
    ahead_sem: float
    follows: Mapping[str, Controllability]  # values by metric; {} without per-window numbers


def robots_of(
    rows: Sequence[Row], sweep: Sweep, provenance: Provenance, windows: Mapping[str, WindowTable]
) -> list[Robot]:
    """The robots in the scope of a sweep, measured in the trials at its default, the most controllable first. If each
    seed judges robots of its own, only seeds that judge all of the scope are used."""
    judging = _judging(sweep)
    ids = {seed: trial_id(trial, provenance) for seed, trial in judging.items()}
    tables = {seed: windows[id] for seed, id in ids.items() if id in windows}
    rows = _rows_of(rows, sweep)
    rate = next((judging[seed].rate for seed in tables), None)
    follows: dict[str, dict[str, Controllability]] = {name: {} for name in sweep.scope}
    for line in controllability(tables, rate=rate) if tables else ():
        follows.setdefault(line.robot, {})[line.metric] = line
    robots = []
    for name in sweep.scope:
        errors = next((follows[name][m].errors for m in ORDER if m in follows[name]), math.nan)
        if not follows[name]:
            errors = _errors_of_rows(rows, sweep, name)
        robots.append(Robot(name, errors, *_ahead(rows, sweep, name, list(tables.values())), follows[name]))
    return sorted(robots, key=lambda r: -r.errors if not math.isnan(r.errors) else math.inf)


def _judging(sweep: Sweep) -> dict[int, Trial]:
    """{seed: its trial at the default}, for the seeds that judge exactly the robots of the sweep's scope."""
    scope = set(sweep.scope)
    return {
        p.trial.train.seed: p.trial
        for p in sweep.points
        if p.role == POINT and p.x == sweep.reference_x and set(p.scope or scope) == scope <= set(p.trial.evaluated)
    }


def _rows_of(rows: Sequence[Row], sweep: Sweep) -> list[Row]:
    """Rows of one sweep, for the seeds whose robots are shown: these seeds judge one set of windows."""
    seeds = _judging(sweep)
    return [r for r in of_sweep(rows, sweep.name) if r.seed in seeds]


def _errors_of_rows(rows: Sequence[Row], sweep: Sweep, name: str) -> float:
    """Distance from zero, in standard errors, of the first metric in ORDER, for trials that kept no numbers of their
    windows."""
    points = (_at_reference(rows, sweep, metric, name) for metric in ORDER)
    return next((p.mean / p.sem for p in points if p and p.sem > 0), math.nan)


def _ahead(rows: Sequence[Row], sweep: Sweep, name: str, tables: Sequence[WindowTable]) -> tuple[float, float]:
    """dB above copying, window by window, averaged over seeds, clustered by episode; without windows from means, and
    then without an error."""
    own = [t.of(name) for t in tables]
    own = [t for t in own if len(t) and {"psnr", "psnr_copy"} <= t.metrics.keys()]
    if own:
        first = own[0]
        differences = [t.aligned_to(first).metrics["psnr"] - t.aligned_to(first).metrics["psnr_copy"] for t in own]
        stat = mean_and_sem(sum(differences) / len(differences), first.episode)
        return stat.mean, stat.sem
    psnr, copy = (_at_reference(rows, sweep, metric, name) for metric in ("psnr", "psnr_copy"))
    return (psnr.mean - copy.mean if psnr and copy else math.nan), math.nan


def _at_reference(rows: Sequence[Row], sweep: Sweep, metric: str, scope: str) -> CurvePoint | None:
    return next((p for p in curve(rows, sweep.name, metric, scope=scope) if p.x == sweep.reference_x), None)


def describe_robots(rows: Sequence[Row], sweep: Sweep, robots: Sequence[Robot], data_summary: Path) -> str:
    """A line per robot, and the mean; data.json says how much data each had."""
    data, rows = read_data(data_summary), _rows_of(rows, sweep)
    measured = {r.metric for r in rows}
    metrics = [m for m in COLUMNS if m in measured]
    follows = [m for m in FOLLOWS if any(m in r.follows for r in robots)]
    shares = {r.name: line.explained for r in robots for line in r.follows.values() if not math.isnan(line.explained)}

    def cell(name: str, metric: str) -> str:
        at = _at_reference(rows, sweep, metric, name)
        return pm(at.mean, at.sem) if at else "–"

    def followed(robot: Robot, metric: str) -> str:
        line = robot.follows.get(metric)
        return pm(line.mean, line.sem) if line else "–"

    columns: dict[str, tuple[Callable[[Robot], str], str]] = {}  # heading -> (cell of a robot, of all)
    if shares:
        columns["explained by actions"] = (lambda r: f"{shares[r.name]:.0%}" if r.name in shares else "–", "")
    if are_sorted(robots):
        columns["s.e. above zero"] = (lambda r: _errors(r.errors), "")
    columns |= {METRICS[m].heading: (partial(followed, metric=m), cell(OVERALL, m)) for m in follows}
    if not all(math.isnan(robot.ahead) for robot in robots):
        columns["ahead of copying (dB)"] = (_ahead_words, "")
    columns |= {METRICS[m].heading: (lambda r, m=m: cell(r.name, m), cell(OVERALL, m)) for m in metrics}
    columns |= {
        key: (lambda r, key=key: str(data.get(r.name, {}).get(key, "–")), "") for key in ("episodes", "windows")
    }
    lines = [[html.escape(robot.name), *(of_robot(robot) for of_robot, _ in columns.values())] for robot in robots]
    lines.append(["<b>all</b>", *(of_all for _, of_all in columns.values())])
    seeds = ", ".join(map(str, _judging(sweep)))
    whose = f"Each seed judges robots of its own: these are those of seed {seeds}. " * sweep.robots_vary
    words = whose + _words(robots, follows, bool(shares), "psnr" in metrics)
    return f"<p>{words}</p>" + table(["robot", *columns], lines)


def are_sorted(robots: Sequence[Robot]) -> bool:
    """Whether the robots have an order: models that predict no frames give none, since nothing says how well actions
    are followed."""
    return not all(math.isnan(robot.errors) for robot in robots)


def _words(robots: Sequence[Robot], follows: Sequence[str], shares: bool, frames: bool) -> str:
    lines = [line for robot in robots for line in robot.follows.values()]

    def counted(metric: str) -> str:
        (more, of), chance = count_following(lines, metric), expected_by_chance(lines, metric)
        beside = "" if chance is None else f" (by chance {chance:.1f})"
        return f"{METRICS[metric].label} of {more} of {of} robots{beside}"

    order = next((METRICS[m].label for m in ORDER if m in follows), "")
    text = f"Sorted by how many standard errors the {order} lies above zero. " if order else ""
    if follows:
        parts = "; ".join(map(counted, follows))
        text += f"More than two standard errors above a model that ignores actions are: {parts}. "
    if shares:
        text += "<em>Explained by actions</em>: the share of the true change of pixels that actions explain. "
    if "retrieval" in follows:
        text += "<em>Retrieval</em>: how often the true actions are the most likely of all that were tried. "
    if "counterfactual_gain" in follows:
        text += (
            "<em>Counterfactual</em>: PSNR against the simulator's frames under other actions, of frames predicted under "
            "these minus frames predicted under the recorded ones. "
        )
    if not frames:
        return text + "Errors are standard errors over episodes, and over seeds where there are several."
    return text + (
        "PSNR and SSIM are of the rollout against the recorded frames; <em>copying</em> is the PSNR of repeating the "
        "last given frame. Errors are standard errors over episodes, and over seeds where there are several; those of "
        "<em>ahead</em> over episodes."
    )


def _errors(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f'<span class="{"finished" if value > 2 else "missing"}">{value:.1f}</span>'.replace("-", "\u2212")


def _ahead_words(robot: Robot) -> str:
    if math.isnan(robot.ahead):
        return "–"
    words = ("+" if robot.ahead > 0 else "") + pm(robot.ahead, robot.ahead_sem)
    return words if robot.ahead > 0 else f'<span class="failed">{words}</span>'
