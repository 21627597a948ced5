"""What trials were trained on, for the page: the mixture of the reference, and how it and the data change along an axis
that caps trajectories."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from data_pipelines.loading.selection import Drawn
from experiments.report.pieces import table
from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trajectories_of, trial_id
from experiments.sweeps.sweep import POINT, Sweep
from experiments.terminal.words import OF_MIXTURE, counted, mixture_rows

NOTABLE = 0.01
"""A dataset's share of the draws is reported if it changes along an axis by at least this much."""


@dataclass(frozen=True)
class PointData:
    """What the finished trials at one position of an axis were trained on, all seeds together."""

    x: float
    trajectories: Counter[str]
    shares: Mapping[str, float]  # shares of the draws, mean over seeds; {} if results do not say it


def describe_mixture(trial: Trial, result: Mapping[str, Any]) -> str:
    """A line per dataset on the amount of data and how often it was drawn; '' for one dataset, and for results
    that do not record it."""
    draws = trial.train.steps * trial.train.batch
    drawn = {name: Drawn(result["trajectories"][name], **one) for name, one in result.get("mixture", {}).items()}
    if len(drawn) < 2:
        return ""
    lines = [[html.escape(name), *cells] for name, *cells in mixture_rows(drawn, draws)]
    counts = "windows of all trajectories" if trial.weighed == "all" else "windows"
    return (
        f"<p>A dataset with n {counts} is drawn with a probability in proportion to n<sup>1/{trial.tau:g}</sup>. Passes: how often "
        f"each of its windows is seen in {counted(trial.train.steps, 'step')} of {trial.train.batch}.</p>"
        + table(OF_MIXTURE, lines)
    )


def describe_data_along(
    sweep: Sweep, provenance: Provenance, results: Mapping[str, Mapping[str, Any]], available: Mapping[str, int]
) -> str:
    """Which points of an axis that caps trajectories had no more trajectories than the point before, and how the
    mixture changes along the axis; '' for other axes."""
    points = _points(sweep, provenance, results, available)
    text = ""
    if same := [(a.x, b.x) for a, b in pairwise(points) if a.trajectories == b.trajectories]:
        pairs = ", ".join(f"from {a:,} to {b:,}" for a, b in same)
        text += (
            f"<p>No dataset has more trajectories {pairs}: the trials there were trained on the same ones, so that nothing is "
            "measured of what more would bring.</p>"
        )
    changes = {
        name: (points[0].shares[name], points[-1].shares[name])
        for name in (points[0].shares if points else ())
        if name in points[-1].shares
    }
    if changes:
        name, (before, after) = max(changes.items(), key=lambda item: abs(item[1][1] - item[1][0]))
        if abs(after - before) >= NOTABLE:
            text += (
                f"<p>Shares of the draws follow the windows that are used, so they change along this axis too: that of "
                f"{html.escape(name)} most, from {before:.1%} at {points[0].x:,} to {after:.1%} at {points[-1].x:,}. With "
                "weighed=all they would not.</p>"
            )
    return text


def _points(
    sweep: Sweep, provenance: Provenance, results: Mapping[str, Mapping[str, Any]], available: Mapping[str, int]
) -> list[PointData]:
    own = [p for p in sweep.points if p.role == POINT]
    if not sweep.single_curve or len({p.trial.max_trajectories for p in own}) < 2:
        return []
    seeds = {p.trial.train.seed for p in own if trial_id(p.trial, provenance) in results}
    points = []
    for x in sorted({p.x for p in own}):
        here = [(p.trial, results.get(trial_id(p.trial, provenance))) for p in own if p.x == x]
        finished = [(trial, result) for trial, result in here if result is not None]
        if {trial.train.seed for trial, _ in finished} != seeds:
            continue
        used = sum((Counter(trajectories_of(trial, available, result)) for trial, result in finished), Counter())
        mixtures = [result["mixture"] for _, result in finished if "mixture" in result]
        names = mixtures[0] if len(mixtures) == len(finished) and mixtures else ()
        shares = {name: sum(m[name]["share"] for m in mixtures) / len(mixtures) for name in names}
        if used:
            points.append(PointData(x, used, shares))
    return points
