"""Figures of sweeps as PNG, with numbers only from rows of the tidy CSV.

Curves over one number are drawn here, axes of names in `plot_names`, families of curves in
`plot_families`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from experiments.analysis.rows import UNTRAINED, CurvePoint, Row, of_sweep
from experiments.analysis.scaling import trunk_parameters
from experiments.report.plot_families import plot_family
from experiments.report.plot_names import plot_names
from experiments.report.plot_style import (
    COLOURS,
    LABELS,
    MUTED,
    ON_LOG,
    ONE_SEED,
    OVER,
    STYLE,
    axis_of_points,
    count,
    drawn_curve,
    drawn_metrics,
    in_unit,
    name_axis,
    plain_log,
    save,
    show_control,
    show_legend,
    show_means,
    show_nothing,
    show_tally,
)
from experiments.sweeps.sweep import CONTROL, Sweep


def plot_sweep(rows: Sequence[Row], sweep: Sweep, path: Path) -> None:
    """One axis: a panel per metric."""
    rows = of_sweep(rows, sweep.name)
    with plt.rc_context(STYLE):
        if sweep.labels:
            figure = plot_names(rows, sweep)
        elif sweep.has_series:
            figure = plot_family(rows, sweep)
        else:
            metrics = drawn_metrics(rows, [sweep.name])
            figure, panels = plt.subplots(
                1, len(metrics), figsize=(4.3 * len(metrics), 3.5), layout="constrained", squeeze=False
            )
            for panel, metric in zip(panels[0], metrics, strict=True):
                _draw(panel, rows, sweep, metric)
            show_legend(figure, panels.flat)
        save(figure, path)


def plot_overview(rows: Sequence[Row], sweeps: Sequence[Sweep], path: Path) -> None:
    """All scaling curves in one figure: a column per sweep, laid out as figure 6 of the paper.

    Without any scaling curve, no file is written.
    """
    path.unlink(missing_ok=True)
    if not sweeps:
        return
    metrics = drawn_metrics(rows, [s.name for s in sweeps])
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            len(metrics), len(sweeps), figsize=(3.9 * len(sweeps), 3.1 * len(metrics)),
            layout="constrained", squeeze=False,
        )  # fmt: skip
        for column, sweep in enumerate(sweeps):
            own = of_sweep(rows, sweep.name)
            for panel, metric in zip(panels[:, column], metrics, strict=True):
                _draw(panel, own, sweep, metric)
                if column:
                    panel.set_ylabel("")
        show_legend(figure, panels.flat)
        save(figure, path)


def _draw(panel: Axes, rows: Sequence[Row], sweep: Sweep, metric: str) -> None:
    """One curve with standard errors, the points of several seeds, and the reference lines."""
    points = drawn_curve(rows, sweep, metric)
    colour = COLOURS[metric]
    if points:
        several, one = (in_unit(s, points) for s in (f"mean ± s.e. over {OVER[sweep.robots_vary]}", ONE_SEED))
        show_means(
            panel, points, [p.x for p in points], several, one, color=colour, marker="o",
            markersize=5.5, linewidth=1.8, capsize=3, elinewidth=1.2, zorder=3,
        )  # fmt: skip
        if scattered := [p for p in points if len(p.seeds) > 1]:
            panel.plot(
                [p.x for p in scattered for _ in p.seeds], [v for p in scattered for v in p.seeds.values()],
                "o", color=colour, alpha=0.45, markersize=3.5, markeredgewidth=0, zorder=4, label="seeds",
            )  # fmt: skip
        _x_axis(panel, points, sweep)
    else:
        show_nothing(panel)
    show_control(panel, drawn_curve(rows, sweep, metric, CONTROL))
    if metric in ON_LOG:
        plain_log(panel, panel.yaxis)
        for p in drawn_curve(rows, sweep, metric, UNTRAINED):  # far above: a line would flatten the curve
            value = f"{p.mean:.0f}" if metric == "perplexity" else f"{p.mean:.3g}"
            panel.set_title(f"untrained: {value}", loc="left", fontsize=8.5, color=MUTED)
    else:
        panel.axhline(0, color=MUTED, linewidth=0.9, zorder=1)
    show_tally(panel, rows, sweep.name)
    whose = " · controls: on their seed's robots alone" if sweep.robots_vary else ""
    name_axis(panel, sweep.axis + (" · trunk parameters" if sweep.name == "width" else "") + whose)
    panel.set_ylabel(LABELS[metric])


def _x_axis(panel: Axes, points: list[CurvePoint], sweep: Sweep) -> None:
    names = [count(p.x) for p in points]
    if sweep.name == "width":
        trunks = {p.x: trunk_parameters(p.trial.model) for p in sweep.points}
        names = [f"{p.x}\n{count(trunks[p.x])}" for p in points]
    axis_of_points(panel, [p.x for p in points], names, room=2 if len(points) == 1 else None)
