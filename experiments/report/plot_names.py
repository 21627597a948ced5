"""Figure of a sweep over names: a line per variant, its mean, its standard error and every seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from experiments.analysis.rows import CurvePoint, Row
from experiments.report.plot_style import (
    CONTROL_LINE,
    DEFAULT,
    LABELS,
    MUTED,
    ON_LOG,
    bars_of,
    drawn_curve,
    drawn_metrics,
    plain_log,
    say_bars,
    show_caption,
    show_nothing,
    show_tally,
)
from experiments.sweeps.sweep import CONTROL, Sweep

CAPTION = (
    "dots: seeds; {bars}; variants are paired, {judged}:\n"
    "the table has the errors of their differences\n"
    "dashed: the default trained on shuffled actions, one seed{whose}"
)
JUDGED = {False: "all judged on the same windows", True: "each seed judged on robots of its own"}
WHOSE = {False: "", True: " and its robots: do not compare it with the means"}
"""Both by whether judged robots are drawn anew for every seed."""
DOTS: dict[bool, dict[str, Any]] = {
    True: dict(alpha=0.45, markersize=4, markeredgewidth=0),
    False: dict(markersize=4.5, markerfacecolor="white", zorder=4),
}
"""Style of the seeds' dots, by whether there are several: a single one lies on the mean."""


def plot_names(rows: Sequence[Row], sweep: Sweep) -> plt.Figure:
    """A panel per metric, names down the side in the order of the sweep, the default in its own colour."""
    metrics = drawn_metrics(rows, [sweep.name])
    figure, panels = plt.subplots(
        1, len(metrics), figsize=(2.4 + 3.4 * len(metrics), 1.8 + 0.36 * len(sweep.labels)),
        layout="constrained", sharey=True, squeeze=False,
    )  # fmt: skip
    points = []
    for panel, metric in zip(panels[0], metrics, strict=True):
        points += _draw(panel, rows, sweep, metric)
    panels[0, 0].set_yticks(range(len(sweep.labels)), sweep.labels)
    panels[0, 0].set_ylim(len(sweep.labels) - 0.4, -0.6)  # the first on top
    panels[0, 0].get_yticklabels()[int(sweep.reference_x)].set(color=DEFAULT, fontweight="bold")
    bars = say_bars(points, sweep.robots_vary, "hollow dot")
    show_caption(figure, CAPTION.format(bars=bars, judged=JUDGED[sweep.robots_vary], whose=WHOSE[sweep.robots_vary]))
    return figure


def _draw(panel: Axes, rows: Sequence[Row], sweep: Sweep, metric: str) -> list[CurvePoint]:
    """Draws one panel; returns the points that are drawn."""
    points = drawn_curve(rows, sweep, metric)
    for p, bar in zip(points, bars_of(points), strict=True):
        colour = DEFAULT if p.x == sweep.reference_x else MUTED
        panel.plot(list(p.seeds.values()), [p.x] * len(p.seeds), "o", color=colour, **DOTS[len(p.seeds) > 1])
        panel.errorbar(
            p.mean, p.x, xerr=bar or None, color=colour, marker="|", markersize=13,
            markeredgewidth=2.2, capsize=3.5, elinewidth=1.5,
        )  # fmt: skip
    if not points:
        show_nothing(panel)
    for control in drawn_curve(rows, sweep, metric, CONTROL):
        panel.axvline(control.mean, **CONTROL_LINE)
    if metric in ON_LOG:
        plain_log(panel, panel.xaxis)
    else:
        panel.axvline(0, color=MUTED, linewidth=0.9, zorder=1)
    show_tally(panel, rows, sweep.name)
    panel.grid(axis="y", visible=False)
    panel.set_xlabel(LABELS[metric])
    return points
