"""The section of the report on scaling fits: coefficients with intervals, predictions with outcomes, best sizes."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from experiments.analysis.fits import DRAWS, FIT_LEVEL, Coefficient
from experiments.analysis.isoflop import IsoFlop
from experiments.analysis.powerlaw import FLOOR
from experiments.analysis.predictions import Outcome
from experiments.analysis.scaling import CurveFit
from experiments.report.pieces import table
from experiments.terminal.words import counted

VERDICTS = {None: "", True: "<span class=finished>inside</span>", False: "<span class=failed>outside</span>"}

DIGITS = 6
"""Significant digits in the table of fits: few enough that the file has the same bytes on machines that round
differently."""


@dataclass(frozen=True)
class FitRow:
    """A line of fits.csv: one coefficient or, if there is no fit, the reason."""

    curve: str
    axes: str
    trials: int
    coefficient: str
    value: str
    low: str
    high: str
    refused: str
    doubts: str


def fit_rows(fits: Sequence[CurveFit], isoflop: IsoFlop | None) -> list[FitRow]:
    rows = []
    for fitted in fits:
        fit, label = fitted.fit, (fitted.curve.name, " x ".join(fitted.curve.axes), len(fitted.fit.trials))
        rows += _rows(label, () if fit.refused else fit.coefficients, fit.refused, fit.doubts)
    if isoflop is not None:
        coefficients = filter(None, (isoflop.exponent, isoflop.near))
        best = [b for b in isoflop.budgets if b.best]
        doubts = (*isoflop.doubts, *(f"{b.flops:.4g} FLOPs: {b.remarks}" for b in best if b.doubts))
        rows += _rows(("isoflop", "training FLOPs", len(best)), coefficients, isoflop.refused, doubts)
        for b in isoflop.budgets:
            label = (f"isoflop {b.flops:.4g}", "trunk parameters", len(b.sizes))
            rows += _rows(label, filter(None, (b.best, b.near)), b.refused, b.doubts)
    return rows


def _rows(
    label: tuple[str, str, int], coefficients: Iterable[Coefficient], refused: str, doubts: Sequence[str]
) -> list[FitRow]:
    last = (refused, "; ".join(doubts))
    numbers = [(c.name, *(f"{v:.{DIGITS}g}" for v in (c.value, c.low, c.high))) for c in coefficients]
    return [FitRow(*label, *n, *last) for n in numbers or [("", "", "", "")]]


def describe_fits(fits: Sequence[CurveFit], isoflop: IsoFlop | None, outcomes: Sequence[Outcome], drawn: str) -> str:
    """`drawn`: the figures."""
    lines = []
    for fitted in fits:
        name, fit = html.escape(fitted.curve.name), fitted.fit
        axes = html.escape(", ".join(fitted.curve.axes))
        if fit.refused:
            lines.append([name, axes, "–", "–", "–", f"No fit: {html.escape(fit.refused)}."])
            continue
        exponents = "; ".join(_with_interval(c) for c in fit.coefficients if c.name in ("alpha", "beta"))
        formula, constant, interval = with_constant(fitted)
        constant += f" <span class=sem>{interval}</span>" if interval else ""
        remarks = html.escape(". ".join(d[0].upper() + d[1:] for d in fit.doubts))
        lines.append([
            name, axes, _as_html(formula), exponents, constant, f"{remarks}." if remarks else ""
        ])  # fmt: skip
    head = ["curve", "over", "L, nats per token", "exponent", "E", "remarks"]
    return (
        "<p>The law is L = E + A x<sup>\u2212\u03b1</sup>: L is the loss in nats per held-out token, x the position on "
        "the axis. It is fitted by the Huber loss in the logarithm, points weighted by the measured scatter of seeds. "
        f"Brackets are {FIT_LEVEL:.0%} intervals of {DRAWS:,} bootstraps over seeds and episodes. A fit describes these robots, "
        "this tokenizer and this range; beyond its last point it is an extrapolation, which only predictions can test.</p>"
        f"{drawn}{table(head, lines, text=6)}{_outcomes(outcomes)}{_isoflop(isoflop)}"
    )


def _as_html(formula: str) -> str:
    """'x^-0.5' with a raised exponent."""
    return re.sub(r"\^-([\d.e+-]+)", "<sup>\u2212\\1</sup>", html.escape(formula))


def _with_interval(c: Coefficient) -> str:
    name = {"alpha": "\u03b1\u00a0=\u00a0", "beta": "\u03b2\u00a0=\u00a0"}.get(c.name, "")
    return f"{name}{c.value:.3g} <span class=sem>[{c.low:.3g}, {c.high:.3g}]</span>"


def with_constant(fitted: CurveFit) -> tuple[str, str, str]:
    """(formula, E, interval of E) of a fit that is not refused. An E below `zero` is the bound of the search, not a
    measurement, and is left out of the formula."""
    e, zero = fitted.fit["E"], 10 * FLOOR * float(fitted.measured.value.min())  # as when doubts count bootstraps
    value, low, high = ("0" if v < zero else f"{v:.3g}" for v in (e.value, e.low, e.high))
    at_bound = e.value < zero
    interval = f"[{low}, {high}]" if e.high >= zero else ""
    return fitted.fit.formula(constant=not at_bound), value + " (at the bound)" * at_bound, interval


def _outcomes(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return ""
    lines = []
    for o in outcomes:
        p = o.prediction
        observed = f"{o.observed:.4f}" if o.observed is not None else "–" if o.seeds else "not run yet"
        predicted = f"{p.mean:.4f} <span class=sem>[{p.low:.4f}, {p.high:.4f}]</span>"
        lines.append([
            html.escape(p.curve), html.escape(p.position), predicted, observed, VERDICTS[o.inside], f"{o.seeds} of {len(p.trials)}",
            html.escape("; ".join(o.marks)),
        ])  # fmt: skip
    head = ["curve", "at", "predicted", "observed", "", "seeds", "remarks"]
    return f"<h3>Preregistered predictions</h3>{table(head, lines, text=7)}"


def _isoflop(isoflop: IsoFlop | None) -> str:
    if isoflop is None:
        return ""
    lines = []
    for b in isoflop.budgets:
        best = [_with_interval(n) if n else "–" for n in (b.best, b.near)]
        lines.append([f"{b.flops:.3g}", str(len(b.sizes)), *best, html.escape(b.remarks)])
    sentence = _best_size(isoflop) if isoflop.exponent else f"No power law: {html.escape(isoflop.refused)}."
    head = ["training FLOPs", "sizes", "best trunk parameters", "by three sizes", "remarks"]
    return f"<h3>The best size for each compute budget</h3><p>{sentence}</p>{table(head, lines, text=5)}"


def _best_size(isoflop: IsoFlop) -> str:
    """How the best size grows, by both forms, and what is doubtful about it."""

    def power(a: Coefficient) -> str:
        return f"C<sup>{a.value:.2f}</sup> <span class=sem>[{a.low:.2f}, {a.high:.2f}]</span>".replace("-", "\u2212")

    grows = "How the best size grows is doubtful: as" if isoflop.doubts else "The best size grows as"
    said = (
        f"{grows} {power(isoflop.exponent)} by a parabola through up to five sizes, as {power(isoflop.near)} by one "
        "through the best size and its two neighbours."
    )
    said += "".join(f" {html.escape(doubt[0].upper() + doubt[1:])}." for doubt in isoflop.doubts)
    best = [b for b in isoflop.budgets if b.best]
    if doubtful := sum(bool(b.doubts) for b in best):
        said += (
            f" {doubtful} of its {counted(len(best), 'best size')} {'is' if doubtful == 1 else 'are'} doubtful (remarks), "
            "which the interval does not include."
        )
    return said
