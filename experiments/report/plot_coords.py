"""The figure of a coordinate check: sizes of activations, and their change in training, over the width."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from experiments.report.plot_style import MUTED, SHADES, STYLE, axis_of_points, plain_log, save, show_legend
from hma_jax.diagnostics.coordinate_check import Size

ROWS = {"size": "size (RMS)", "change": "change since step 0 (RMS)"}


def plot_coords(rows: Sequence[Size], path: Path) -> None:
    """A column per activation: at the top its size, at the bottom its change since step 0; a line per training step,
    the mean over seeds. A line is level if the value does not depend on the width."""
    quantities, widths = list(dict.fromkeys(r.quantity for r in rows)), sorted({r.width for r in rows})
    last, lines = max(r.step for r in rows), defaultdict(lambda: defaultdict(list))
    for r in rows:
        for what in ROWS:
            lines[what, r.quantity, r.step][r.width].append(getattr(r, what))
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            len(ROWS), len(quantities), figsize=(0.6 + 2.6 * len(quantities), 5.6),
            layout="constrained", sharex=True, squeeze=False,
        )  # fmt: skip
        for (what, quantity, step), by_width in lines.items():
            panel = panels[list(ROWS).index(what), quantities.index(quantity)]
            means = [np.mean(by_width[width]) for width in widths]
            if step or what == "size":  # at step 0 nothing has changed
                panel.plot(
                    widths, means, "o-", color=plt.get_cmap("viridis")(SHADES * step / max(last, 1)), markersize=3,
                    linewidth=1.2, label=f"step {step}",
                )  # fmt: skip
        for panel, quantity in zip(panels[0], quantities, strict=True):
            panel.set_title(quantity, fontsize=10)
        for panel, label in zip(panels[:, 0], ROWS.values(), strict=True):
            panel.set_ylabel(label)
        for panel in panels.ravel():
            axis_of_points(panel, widths, [str(width) for width in widths])
            drawn = np.array([line.get_ydata() for line in panel.lines])
            if (np.isfinite(drawn) & (drawn > 0)).any():
                plain_log(panel, panel.yaxis)
            else:  # a log axis needs a number
                panel.text(0.5, 0.5, "zero or not finite", transform=panel.transAxes, ha="center", color=MUTED)
        for panel in panels[-1]:
            panel.set_xlabel("width")
        show_legend(figure, panels[0])
        save(figure, path)
