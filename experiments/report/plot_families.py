"""Figure of several curves over one number: learning rates at several widths, with muP and without."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from experiments.analysis.optima import diverged, ends, lowest
from experiments.analysis.rows import OVERALL, TRAINING, TRAINING_LOSS, CurvePoint, Row, all_series
from experiments.report.plot_style import (
    EXP_OF,
    LABELS,
    MUTED,
    ON_LOG,
    axis_of_points,
    count,
    dodge,
    drawn_curve,
    drawn_metrics,
    name_axis,
    plain_log,
    say_bars,
    show_caption,
    show_control,
    show_legend,
    show_means,
    show_nothing,
    show_tally,
    style_of,
)
from experiments.sweeps.sweep import CONTROL, POINT, STANDARD, Sweep

ROLES = {POINT: "muP", STANDARD: "standard parametrisation"}
DRAWN = {
    TRAINING_LOSS: (TRAINING, "training loss, last tenth of steps"),
    **{metric: (OVERALL, LABELS[metric]) for metric in ON_LOG},
}
"""Metrics, with scope and label, for curves that are compared by the position of their minimum."""
CURVES = {metric: (OVERALL, label) for metric, label in LABELS.items()}
PAIRED = "; points are paired, on the same windows"
OF_BASE = (
    "\nstar: lowest, hollow at an end of the grid or of one seed; cross: diverged; dotted: lowest of the base curve"
)


def plot_family(rows: Sequence[Row], sweep: Sweep) -> plt.Figure:
    """A row of panels per role, a column per metric, a colour and a marker per series."""
    series = all_series(rows, sweep.name)
    metrics = drawn_metrics(rows, [sweep.name])
    if sweep.base:
        measured = {r.metric for r in rows if r.sweep == sweep.name}
        metrics = [m for m in DRAWN if EXP_OF.get(m, m) in measured] or [TRAINING_LOSS, "perplexity"]
    figure, panels = plt.subplots(
        len(series), len(metrics), figsize=(4.3 * len(metrics), 0.7 + 2.9 * len(series)),
        layout="constrained", sharex=True, sharey="col", squeeze=False,
    )  # fmt: skip
    points = []
    for line, role in zip(panels, series, strict=True):
        for panel, metric in zip(line, metrics, strict=True):
            points += _draw(panel, rows, sweep, metric, role, series[role])
            if len(series) > 1:
                panel.set_title(ROLES[role], loc="left", fontsize=10)
    for column, metric in zip(panels.T, metrics, strict=True):
        name_axis(column[-1], sweep.axis)
        if metric in ON_LOG and any(panel.containers for panel in column):
            plain_log(column[-1], column[-1].yaxis)
    show_tally(panels[0, -1], rows, sweep.name)
    show_legend(figure, panels.flat)
    lost = any(diverged(rows, sweep.name, role, name) for role, names in series.items() for name in names)
    marks = OF_BASE if sweep.base else "\ncross: a seed diverged, the point is left out" * lost
    bars = say_bars(points, sweep.robots_vary, training=TRAINING_LOSS in metrics)
    show_caption(figure, bars + PAIRED + marks)
    return figure


def _draw(
    panel: Axes, rows: Sequence[Row], sweep: Sweep, metric: str, role: str, series: Sequence[str]
) -> list[CurvePoint]:
    """Draws one panel; returns the points that are drawn."""
    drawn = []
    scope, metric_label = (DRAWN if sweep.base else CURVES)[metric]
    xs = sorted({r.x for r in rows if r.sweep == sweep.name})
    for i, name in enumerate(series):
        style = style_of(i, len(series))
        colour = style["color"]
        lost = diverged(rows, sweep.name, role, name)
        for x in lost:  # on the upper edge: above any loss
            panel.plot(x, 0.97 - 0.05 * i, "x", color=colour, transform=panel.get_xaxis_transform())
        points = [p for p in drawn_curve(rows, sweep, metric, role, scope, name) if p.x not in lost]
        best = lowest(points, lost)
        if best is None:
            continue
        aside = dict(zip((p.x for p in points), dodge([p.x for p in points], i, len(series), xs), strict=True))
        label = name + (" (base)" if name == sweep.base else "")
        show_means(
            panel, points, list(aside.values()), label, label, **style,
            markersize=5, linewidth=1.6, capsize=2.5, elinewidth=1.1, zorder=2,
        )  # fmt: skip
        drawn += points
        if not sweep.base:
            continue
        unsure = len(best.seeds) == 1 or best.x in ends(rows, sweep.name, role, name)
        panel.plot(
            aside[best.x], best.mean, "*", markersize=13, color=colour, zorder=4,
            markerfacecolor="white" if unsure else colour,
        )  # fmt: skip
        if name == sweep.base:
            panel.axvline(best.x, color=MUTED, linewidth=1, linestyle=":", zorder=1)
    if role == POINT:
        show_control(panel, drawn_curve(rows, sweep, metric, CONTROL, scope), sweep.beside_controls)
    if not panel.containers:
        show_nothing(panel)
    axis_of_points(panel, xs, [count(x) if x >= 1 else f"{x:.2g}" for x in xs], room=1.25)
    panel.set_ylabel(metric_label)
    return drawn
