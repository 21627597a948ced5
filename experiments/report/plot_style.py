"""What all figures have in common: colours, metrics and their axes, saving."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from experiments.rows import CurvePoint, Row, tally

INK, MUTED, GRID = "#22262b", "#6f7780", "#e4e7ea"
COLOURS = {"perplexity": "#2b5c8a", "delta_psnr": "#b3541e"}
DEFAULT = "#6b3fa0"
"""Of the variant that the presets use, as in the paper's figure 5."""
LABELS = {
    "perplexity": "perplexity",
    "delta_psnr": "ΔPSNR, last frame (dB)",
}
"""The metrics that are drawn, where there are any."""
CONTROL_LINE = dict(color=MUTED, linewidth=1.3, linestyle=(0, (4, 2)), zorder=1)
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


def drawn_metrics(rows: Iterable[Row], sweeps: Collection[str]) -> list[str]:
    """Those of LABELS that a trial of the sweeps has (a continuous model has no perplexity), or
    all of them while none has finished."""
    measured = {r.metric for r in rows if r.sweep in sweeps}
    return [m for m in LABELS if m in measured] or list(LABELS)


def save(figure: plt.Figure, path: Path) -> None:
    aside = path.with_suffix(".tmp.png")
    figure.savefig(aside, dpi=160, metadata={"Software": None})
    plt.close(figure)
    aside.replace(path)


def plain_log(panel: Axes, axis: Axis) -> None:
    """A log scale for values within a decade or two, with plain numbers at 1, 2, 3 and 5."""
    panel.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def show_control(panel: Axes, points: list[CurvePoint]) -> None:
    """A line where the trial on shuffled actions finished, with its standard error."""
    if not points:
        return
    mean, sem = points[-1].mean, points[-1].sem
    panel.axhline(mean, **CONTROL_LINE, label="shuffled actions")
    if sem > 0:  # not nan
        panel.axhspan(mean - sem, mean + sem, color=MUTED, alpha=0.12, linewidth=0, zorder=0)


def show_tally(panel: Axes, rows: Iterable[Row], sweep: str) -> None:
    finished, total = tally(rows, sweep)
    panel.set_title(f"{finished} of {total} trials", loc="right", fontsize=8.5, color=MUTED)


def show_nothing(panel: Axes) -> None:
    panel.text(0.5, 0.5, "no finished trial", transform=panel.transAxes, ha="center", color=MUTED)
