"""What policies are trained on to find out what generated trajectories are worth, and what is made of the outcomes."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.analysis.bootstrap import Panel, bootstrap_intervals, resample
from experiments.analysis.intervals import Interval
from experiments.applications.judging.agreement import rate_interval
from experiments.applications.tables import write_table

Trials = dict[tuple[int, int], dict[str, list[float]]]
"""{(place of the condition, seed): {success and distance by start, where a simulator judged; error by held-out
trajectory}}."""


class Condition(NamedTuple):
    """What a policy is trained on: so many recorded trajectories, and so many of the kind `more`."""

    name: str
    recorded: int
    generated: int = 0
    more: str = "generated"


KINDS = ("recorded", "generated", "shuffled")
BLIND_KIND = "blind"
"""Whose trajectories come with the recorded ones; the last are of a model without actions, where there is one."""

CONDITIONS = (
    Condition("10 recorded", 10),
    Condition("10 + 10 generated", 10, 10),
    Condition("10 + 50 generated", 10, 50),
    Condition("10 + 90 generated", 10, 90),
    Condition("10 + 90, other actions", 10, 90, "shuffled"),
    Condition("100 recorded", 100),
    Condition("10 + 90, a model without actions", 10, 90, BLIND_KIND),  # where there is such a model
)

TRIALS, STARTS = "trials.csv", ["condition", "seed", "start", "success", "distance"]
ERRORS, HELD_OUT = "errors.csv", ["condition", "seed", "trajectory", "error"]

FEW, MOST, CONTROL, ALL, BLIND = 0, 3, 4, 5, 6
"""Places in `CONDITIONS` that shares of the gap are made of."""


def places(trials: Trials) -> list[int]:
    """Of the conditions that were tried: all, or all but the last."""
    return [i for i in range(len(CONDITIONS)) if i != BLIND or any(place == BLIND for place, _ in trials)]


def make_panel(trials: Trials, seeds: tuple[int, ...], what: str = "success") -> Panel:
    """Success of every condition, seed and start, or the error by held-out trajectory."""
    own = [tuple(s for s in seeds if (i, s) in trials) for i in places(trials)]  # a run may be under way
    points = [np.array([trials[i, s][what] for s in found], float) for i, found in enumerate(own)]
    each = np.arange(points[0].shape[1])
    return Panel(np.full(len(each), "robot"), each, tuple(points), tuple(own))


def share_closed(panel: Panel, at: int) -> Interval:
    """Which share of the gap between few and all recorded trajectories condition `at` closes; the interval holds 95 %
    of the draws over seeds and starts in which there is a gap."""
    found = resample(panel, 2000)

    def share(points: np.ndarray) -> np.ndarray:
        gap = points[..., ALL] - points[..., FEW]
        return (points[..., at] - points[..., FEW]) / np.where(np.abs(gap) < 1e-9, np.nan, gap)

    drawn = share(found.drawn)
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):  # there is no gap in any
        return Interval(math.nan, math.nan, math.nan, math.nan)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(float(share(found.value)), float(np.std(drawn)), float(low), float(high))


class Summary(NamedTuple):
    """One condition, or how much of the gap from few to all recorded trajectories it closes."""

    name: str
    measured: dict[str, Interval]  # success, where a simulator judged, and error


def summarise(trials: Trials, seeds: tuple[int, ...]) -> list[Summary]:
    """Every condition; then which share of the gap 90 generated trajectories close, and 90 of each control.

    Of policies that never or always succeed resampling knows no spread: the interval is then Wilson's over starts.
    """
    panels = {what: make_panel(trials, seeds, what) for what in ("success", "error") if what in trials[FEW, seeds[0]]}
    found = {what: bootstrap_intervals(panel) for what, panel in panels.items()}
    if "success" in found:
        starts = len(panels["success"].episode)
        found["success"] = [
            rate_interval(np.full(starts, rate.mean)) if rate.mean in (0.0, 1.0) else rate for rate in found["success"]
        ]
    tried = places(trials)
    summaries = [Summary(CONDITIONS[i].name, {what: each[i] for what, each in found.items()}) for i in tried]
    shares = ("10 + 90 generated", MOST), ("other actions", CONTROL), ("a model without actions", BLIND)
    for name, at in shares[: 2 + (BLIND in tried)]:
        closed = {what: share_closed(panel, at) for what, panel in panels.items()}
        summaries.append(Summary(f"share of the gap: {name}", closed))
    return summaries


def write_tables(trials: Trials, seeds: tuple[int, ...], out: Path) -> list[Path]:
    """All outcomes, as `read_trials` reads them. Returns what it wrote."""
    written = []
    for path, names, what in ((TRIALS, STARTS, ("success", "distance")), (ERRORS, HELD_OUT, ("error",))):
        if what[0] not in trials[FEW, seeds[0]]:
            continue
        rows = [
            [c.name, s, k, *(round(value, 5) for value in values)]
            for i, c in enumerate(CONDITIONS)
            for s in seeds
            if (i, s) in trials
            for k, values in enumerate(zip(*(trials[i, s][name] for name in what), strict=True))
        ]
        write_table(out / path, names, rows)
        written.append(out / path)
    return written


def markdown(found: Sequence[Summary]) -> str:
    """The table that docs/generating.md shows; an interval of a rate ends at 0 and 1."""
    titles, digits = {"success": "success", "error": "action error"}, {"success": 2, "error": 3}
    measured = found[0].measured
    lines = [f"| trained on | {' | '.join(f'{titles[what]} | 95 % interval' for what in measured)} |"]
    lines.append(f"|{'---|' * (1 + 2 * len(measured))}")
    for one in found:
        cells = [one.name]
        for what, r in one.measured.items():
            low, high = r.low, r.high
            if what == "success" and not one.name.startswith("share"):
                low, high = max(low, 0.0), min(high, 1.0)
            n = digits[what]
            known = f"{low:.{n}f} to {high:.{n}f}" if math.isfinite(low) else "–"
            cells += [f"{r.mean:.{n}f}" if math.isfinite(r.mean) else "–", known]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def read_trials(directory: Path) -> Trials:
    """What the tables say: {(place of the condition, seed): {success, distance, error}}; without the first two where
    no simulator judged."""
    place_of, trials = {c.name: i for i, c in enumerate(CONDITIONS)}, {}
    for path, what in ((TRIALS, ("success", "distance")), (ERRORS, ("error",))):
        if not (directory / path).exists():
            continue
        with open(directory / path, newline="") as file:
            for row in csv.DictReader(file):
                one = trials.setdefault((place_of[row["condition"]], int(row["seed"])), {})
                for name in what:
                    one.setdefault(name, []).append(float(row[name]))
    return trials
