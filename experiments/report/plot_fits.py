"""Figures of scaling fits: points of every seed, the fit with its band, residuals below; isoFLOP curves."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from experiments.analysis.fits import FIT_LEVEL
from experiments.analysis.isoflop import IsoFlop
from experiments.analysis.predictions import Outcome
from experiments.analysis.scaling import FLOPS, TRUNK, CurveFit
from experiments.report.plot_style import (
    COLOURS,
    DEFAULT,
    INK,
    MUTED,
    STYLE,
    count,
    name_axis,
    plain_log,
    save,
    show_caption,
    show_legend,
    style_of,
)

LINE, BAND = COLOURS["perplexity"], 0.16
ABREAST = 3
"""Number of curves beside each other: with more, nothing on a page would be readable."""
DOUBTED = {False: "-", True: "--"}
"""Lines by whether something is doubtful of them."""
ASIDE = 0.04
"""Part of an axis between a prediction and its outcome."""
POINTS = dict(marker="o", linestyle="none", markersize=4, alpha=0.6, markeredgewidth=0)


def plot_fits(fits: Sequence[CurveFit], outcomes: Sequence[Outcome], path: Path) -> None:
    """Plots the loss of each curve with a fit, and its residuals below, ABREAST curves beside each other. Writes no
    file if no curve has a fit."""
    path.unlink(missing_ok=True)
    fits = [f for f in fits if f.measured is not None and len(f.curve.axes) == 1 and not f.fit.refused]
    if not fits:
        return
    with plt.rc_context(STYLE):
        columns, rows = min(len(fits), ABREAST), math.ceil(len(fits) / ABREAST)
        figure = plt.figure(figsize=(4.3 * columns, 4.6 * rows), layout="constrained")
        cells = figure.add_gridspec(2 * rows, columns, height_ratios=(3, 1) * rows)
        for i, fitted in enumerate(fits):
            row, column = divmod(i, ABREAST)
            above = figure.add_subplot(cells[2 * row, column])
            below = figure.add_subplot(cells[2 * row + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _draw_fit((above, below), fitted, [o for o in outcomes if o.prediction.curve == fitted.curve.name])
            if not column:
                above.set_ylabel("loss, nats per token")
                below.set_ylabel("residual, %")
        save(figure, path)


def _draw_fit(panels: Sequence[Axes], fitted: CurveFit, outcomes: Sequence[Outcome]) -> None:
    above, below = panels
    # Of each doubt, the part before its explanation, which the table has.
    doubts = [line for d in fitted.fit.doubts for line in textwrap.wrap(d.split(":")[0], 66)]
    measured, fit = fitted.measured, fitted.fit
    x, loss = measured.x[:, 0], measured.value
    above.plot(x, loss, color=LINE, label="seeds", zorder=3, **POINTS)
    ends = [x.min(), *(o.prediction.x[0] for o in outcomes), x.max()]
    line = np.geomspace(min(ends) / 1.15, max(ends) * 1.15, 120)[:, None]
    band = f"{FIT_LEVEL:.0%} of bootstraps"
    above.fill_between(line[:, 0], *fit.band(line), color=LINE, alpha=BAND, linewidth=0, label=band)
    above.plot(
        line[:, 0], fit.at(line), color=LINE, linewidth=1.6, linestyle=DOUBTED[bool(fit.doubts)],
        label="fit, all points" + ", doubtful" * bool(fit.doubts),
    )  # fmt: skip
    below.plot(x, 100 * fit.residuals, color=LINE, **POINTS)
    for outcome in outcomes:
        _draw_outcome(above, outcome, line[:, 0])
        _draw_outcome(below, outcome, line[:, 0], float(fit.at(np.array([outcome.prediction.x]))[0]))
    below.axhline(0, color=MUTED, linewidth=0.9, zorder=1)
    above.set_xscale("log")
    plain_log(above, above.yaxis)
    plain_log(below, below.xaxis, count)
    name_axis(below, fitted.curve.axes[0])
    above.set_title(fitted.curve.name, loc="left", fontsize=10, pad=7 + 9 * len(doubts))
    for i, words in enumerate(reversed(doubts)):
        above.annotate(
            words, (0, 1), (0, 4 + 9 * i), xycoords="axes fraction", textcoords="offset points",
            fontsize=7.5, color=MUTED,
        )  # fmt: skip
    above.legend(loc="best")


def _draw_outcome(panel: Axes, outcome: Outcome, line: np.ndarray, fitted: float | None = None) -> None:
    """The interval is drawn beside the observed value, which would hide it, shifted by a part of the axis along `line`.
    If the `fitted` loss at that position is given, both are in per cent of it: among other losses they would be too
    small to judge."""
    p, observed = outcome.prediction, outcome.observed
    values = np.array([p.mean, p.low, p.high, math.nan if observed is None else observed])
    mean, low, high, came = values if fitted is None else 100 * np.log(values / fitted)
    panel.errorbar(
        p.x[0] * (line[-1] / line[0]) ** ASIDE, mean, _bar(mean, low, high), fmt="_", color=DEFAULT, capsize=4,
        markersize=9, elinewidth=1.6, zorder=5, label="predicted before it ran",
    )  # fmt: skip
    if observed is not None:
        panel.plot(
            p.x[0], came, "*", color=INK, markersize=9, markerfacecolor="white", zorder=4, label="observed"
        )  # fmt: skip


def _bar(value: float, low: float, high: float) -> list[list[float]]:
    """The lengths of an error bar below and above. An end of an interval of bootstraps may be beyond the value, if only
    by rounding where all of them are equal: there is no bar on that side."""
    return [[max(value - low, 0.0)], [max(high - value, 0.0)]]


def plot_isoflop(isoflop: IsoFlop | None, path: Path) -> None:
    """Loss over size for each budget with its parabola and minimum, and the best size over budgets."""
    path.unlink(missing_ok=True)
    if isoflop is None or not isoflop.budgets:
        return
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.8), layout="constrained")
        for i, budget in enumerate(isoflop.budgets):
            style = style_of(i, len(isoflop.budgets))
            colour, filling = style["color"], "white" if budget.doubts else style["color"]
            label = f"{count(budget.flops)} FLOPs"
            left.plot(budget.sizes, budget.loss, **style, linestyle="none", markersize=5, label=label)
            if budget.parabola is not None:
                line = np.geomspace(budget.sizes[0], budget.sizes[-1], 80)
                left.plot(line, budget.at(line), color=colour, linewidth=1.4, linestyle=DOUBTED[bool(budget.remarks)])
            if budget.best:
                best = budget.best
                left.plot(
                    best.value, budget.at(np.array([best.value])), "*", color=colour, markersize=13,
                    markerfacecolor=filling, zorder=4,
                )  # fmt: skip
                right.errorbar(
                    budget.flops, best.value, _bar(best.value, best.low, best.high), **style, markerfacecolor=filling,
                    capsize=3,
                )  # fmt: skip
                right.plot(budget.flops, budget.near.value, "x", color=colour, markersize=6, zorder=4)
        if isoflop.exponent:
            flops = np.geomspace(isoflop.budgets[0].flops, isoflop.budgets[-1].flops, 50)
            doubtful = bool(isoflop.doubts) or any(b.doubts for b in isoflop.budgets)
            laws = (("parabola", isoflop.exponent, isoflop.scale, DOUBTED[doubtful]),)
            laws += (("three sizes (crosses)", isoflop.near, isoflop.near_scale, ":"),)
            for form, a, scale, line in laws:
                words = f"{form}: $C^{{{a.value:.2f}}}$ ({a.low:.2f} to {a.high:.2f})"
                right.plot(flops, scale * flops**a.value, color=MUTED, linewidth=1.4, linestyle=line, label=words)
            right.legend(loc="best")
        else:
            right.text(0.5, 0.5, "no power law", transform=right.transAxes, ha="center", color=MUTED)
        for panel, axis, label in ((left, left.xaxis, TRUNK), (right, right.xaxis, FLOPS)):
            plain_log(panel, axis, count)
            panel.set_xlabel(label)
        plain_log(left, left.yaxis)
        plain_log(right, right.yaxis, count)
        left.set_ylabel("loss, nats per token")
        right.set_ylabel(f"best {TRUNK}")
        show_legend(figure, [left])
        words = []
        if isoflop.doubts or any(b.doubts for b in isoflop.budgets):
            words.append("hollow or dashed: doubtful (the table says why)")
        if not isoflop.exponent and any(b.best for b in isoflop.budgets):  # else the law's legend says it
            words.append("crosses: by three sizes")
        if words:
            show_caption(figure, "; ".join(words))
        left.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        save(figure, path)
