"""Scaling curves as PNG, from rows of the tidy CSV and nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from experiments.rows import CurvePoint, Row, curve, tally

INK, MUTED, GRID = "#22262b", "#6f7780", "#e4e7ea"
COLOURS = {"perplexity": "#2b5c8a", "delta_psnr": "#b3541e"}
LABELS = {
    "perplexity": "perplexity",
    "delta_psnr": "ΔPSNR, last frame (dB)",
}
AXES = {
    "datasets": "datasets in the mixture",
    "trajectories": "trajectories per dataset (at most)",
    "width": "model width · parameters",
}
STYLE = {
    "font.size": 10,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def plot_sweep(rows: Sequence[Row], sweep: str, path: Path) -> None:
    """One axis of the study: perplexity and delta PSNR side by side."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(8.6, 3.5), layout="constrained")
        for panel, metric in zip(panels, LABELS, strict=True):
            _draw(panel, rows, sweep, metric)
        _save(figure, path)


def plot_overview(rows: Sequence[Row], sweeps: Sequence[str], path: Path) -> None:
    """All axes in one figure: a column per sweep, laid out as figure 6 of the paper."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            2, len(sweeps), figsize=(3.9 * len(sweeps), 6.2), layout="constrained", squeeze=False
        )
        for column, sweep in enumerate(sweeps):
            for panel, metric in zip(panels[:, column], LABELS, strict=True):
                _draw(panel, rows, sweep, metric)
                if column:
                    panel.set_ylabel("")
        _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    aside = path.with_suffix(".tmp.png")
    figure.savefig(aside, dpi=160, metadata={"Software": None})
    plt.close(figure)
    aside.replace(path)


def _draw(panel: Axes, rows: Sequence[Row], sweep: str, metric: str) -> None:
    """One curve with standard errors, every seed's point, and the reference lines."""
    points = curve(rows, sweep, metric)
    colour = COLOURS[metric]
    if points:
        xs = [p.x for p in points]
        bars = [0.0 if math.isnan(p.sem) else p.sem for p in points]
        panel.errorbar(
            xs, [p.mean for p in points], bars, color=colour, marker="o", markersize=5.5,
            linewidth=1.8, capsize=3, elinewidth=1.2, zorder=3, label="mean ± s.e.",
        )  # fmt: skip
        if any(len(p.seeds) > 1 for p in points):
            panel.plot(
                [p.x for p in points for _ in p.seeds], [v for p in points for v in p.seeds],
                "o", color=colour, alpha=0.45, markersize=3.5, markeredgewidth=0, zorder=4, label="seeds",
            )  # fmt: skip
        _x_axis(panel, points, sweep)
    else:
        panel.text(0.5, 0.5, "no finished trial", transform=panel.transAxes, ha="center", color=MUTED)
    _reference_line(panel, curve(rows, sweep, metric, role="control"), "shuffled actions", (0, (4, 2)))
    if metric == "perplexity":
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        panel.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        panel.yaxis.set_minor_formatter(NullFormatter())
        for p in curve(rows, sweep, metric, role="untrained"):  # far above: a line would flatten the curve
            panel.set_title(f"untrained: {p.mean:.0f}", loc="left", fontsize=8.5, color=MUTED)
    else:
        panel.axhline(0, color=MUTED, linewidth=0.9, zorder=1)
    finished, total = tally(rows, sweep)
    panel.set_title(f"{finished} of {total} trials", loc="right", fontsize=8.5, color=MUTED)
    panel.set_xlabel(AXES.get(sweep, sweep))
    panel.set_ylabel(LABELS[metric])
    if panel.get_legend_handles_labels()[0]:
        panel.legend(loc="best")


def _reference_line(panel: Axes, points: list[CurvePoint], label: str, dashes: tuple) -> None:
    """A horizontal line with its standard error, where such a trial finished."""
    if not points:
        return
    mean, sem = points[-1].mean, points[-1].sem
    panel.axhline(mean, color=MUTED, linewidth=1.3, linestyle=dashes, zorder=1, label=label)
    if sem > 0:  # not nan
        panel.axhspan(mean - sem, mean + sem, color=MUTED, alpha=0.12, linewidth=0, zorder=0)


def _x_axis(panel: Axes, points: list[CurvePoint], sweep: str) -> None:
    """A log axis whose ticks are the points themselves."""
    panel.set_xscale("log")
    names = {p.x: _count(p.x) for p in points}
    if sweep == "width":
        names = {p.x: f"{p.x}\n{_count(p.parameters)}" for p in points}
    panel.xaxis.set_major_locator(FixedLocator(list(names)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda v, _: names.get(round(v), "")))
    panel.xaxis.set_minor_locator(NullLocator())
    if len(points) == 1:
        panel.set_xlim(points[0].x / 2, points[0].x * 2)


def _count(n: float) -> str:
    """1234567 -> '1.2M'."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if n >= size:
            return f"{n / size:.3g}{unit}" if n / size >= 100 or n % size == 0 else f"{n / size:.1f}{unit}"
    return f"{n:g}"
