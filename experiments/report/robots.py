"""The reference trial robot by robot, the most controllable first."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.report.pieces import pm, table
from experiments.rows import OVERALL, CurvePoint, Row, curve
from experiments.running.provenance import Provenance
from experiments.running.trial import trial_id
from experiments.sweeps.sweep import POINT, Sweep
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.evaluation.windows import WindowTable

COLUMNS = {
    "perplexity": "perplexity", "accuracy": "accuracy", "action_nats": "action-nats", "delta_psnr": "ΔPSNR (dB)",
    "psnr": "PSNR (dB)", "psnr_copy": "copying (dB)", "ssim": "SSIM",
}  # fmt: skip
ORDER = ("action_nats", "delta_psnr")
"""Controllability: by the first that was measured."""


@dataclass(frozen=True)
class Robot:
    """What the reference trials, of all seeds, say of one robot."""

    name: str
    control: float  # standard errors of ORDER from zero; nan if it was not measured
    ahead: float  # dB of PSNR ahead of copying the last given frame
    ahead_sem: float


def robots_of(
    rows: Sequence[Row], sweep: Sweep, provenance: Provenance, windows: Mapping[str, WindowTable]
) -> list[Robot]:
    """Of the scope of the sweep that shows the reference trial, the most controllable first."""
    measured = {r.metric for r in rows if r.sweep == sweep.name}
    metric = next((m for m in ORDER if m in measured), None)
    ids = [trial_id(p.trial, provenance) for p in sweep.points if p.role == POINT and p.x == sweep.reference_x]
    tables = [windows[id] for id in ids if id in windows]
    found = []
    for name in sweep.scope:
        at = _at_reference(rows, sweep, metric, name) if metric else None
        control = at.mean / at.sem if at and at.sem > 0 else math.nan
        found.append(Robot(name, control, *_ahead(rows, sweep, name, tables)))
    return sorted(found, key=lambda r: -r.control if not math.isnan(r.control) else math.inf)


def _ahead(rows: Sequence[Row], sweep: Sweep, name: str, tables: Sequence[WindowTable]) -> tuple[float, float]:
    """dB ahead of copying, window by window, seeds averaged, clustered by episode; from means where there are no
    windows, and then without an error."""
    own = [t.of(name) for t in tables]
    own = [t for t in own if len(t) and {"psnr", "psnr_copy"} <= t.metrics.keys()]
    if own:
        first = own[0]
        differences = [t.matched_to(first).metrics["psnr"] - t.matched_to(first).metrics["psnr_copy"] for t in own]
        stat = mean_and_sem(sum(differences) / len(differences), first.episode)
        return stat.mean, stat.sem
    psnr, copy = (_at_reference(rows, sweep, metric, name) for metric in ("psnr", "psnr_copy"))
    return (psnr.mean - copy.mean if psnr and copy else math.nan), math.nan


def _at_reference(rows: Sequence[Row], sweep: Sweep, metric: str, scope: str) -> CurvePoint | None:
    return next((p for p in curve(rows, sweep.name, metric, scope=scope) if p.x == sweep.reference_x), None)


def describe_robots(rows: Sequence[Row], sweep: Sweep, robots: Sequence[Robot], data_summary: Path) -> str:
    """A line per robot, and the mean; data.json says how much there was of each."""
    data = json.loads(data_summary.read_text()) if data_summary.exists() else {}
    measured = {r.metric for r in rows if r.sweep == sweep.name}
    metrics = [m for m in COLUMNS if m in measured]
    order = next((COLUMNS[m].split(" (")[0] for m in ORDER if m in measured), None)

    def cell(name: str, metric: str) -> str:
        at = _at_reference(rows, sweep, metric, name)
        return pm(at.mean, at.sem) if at else "–"

    lines = []
    for robot in (*robots, None):
        name = robot.name if robot else OVERALL
        facts = data.get(name, {})
        counts = [str(facts.get(k, "–")) for k in ("episodes", "windows")]
        lines.append([
            html.escape(name) if robot else "<b>all</b>",
            _errors(robot.control) if robot else "",
            _ahead_words(robot) if robot else "",
            *(cell(name, metric) for metric in metrics),
            *counts,
        ])  # fmt: skip
    beyond = sum(r.control > 2 for r in robots)
    sorted_by = (
        f"Sorted by how many standard errors the {order} lies above zero; {beyond} of {len(robots)} are beyond two. "
        if order
        else ""
    )
    head = ["robot", "s.e. above zero", "ahead of copying (dB)", *(COLUMNS[m] for m in metrics), "episodes", "windows"]
    return (
        f"<p>{sorted_by}PSNR and SSIM are of the rollout against the recorded frames; <em>copying</em> is the PSNR of "
        "repeating the last given frame. Errors are standard errors over episodes and seeds.</p>"
        + table(head, lines)
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
