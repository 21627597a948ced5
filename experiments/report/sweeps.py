"""The section of the report on one sweep: its question, its numbers and what follows from them."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from experiments.analysis.best_steps import BestSteps
from experiments.analysis.changes import Change
from experiments.analysis.growth import GROWS, Growth
from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.optima import Optimum
from experiments.analysis.rows import CurvePoint, Row, all_series, curve, difference
from experiments.report.pieces import pm, table
from experiments.report.plot_families import ROLES
from experiments.report.plot_style import OVER, USUAL, choose_metrics
from experiments.sweeps.sweep import CONTROL, POINT, Sweep
from experiments.terminal.words import counted
from hma_jax.evaluation.measures import METRICS

COLUMNS = (HELD_OUT_LOSS, "perplexity", "diffusion_loss", "delta_psnr", "action_error")
TWO_PERPLEXITIES = (
    "<p>Perplexity is drawn as exp of the mean nats over robots. That of the tables is the release's, a mean of "
    "exponentials: a few hard robots make most of it, so it may rank models otherwise than nats do.</p>"
)
LOSSES = {"cross_entropy": "held out", "loss": "training"}


@dataclass(frozen=True)
class AxisStatistics:
    """Statistics of whole axes."""

    changes: Sequence[Change] = ()
    best: Sequence[BestSteps] = ()
    growth: Sequence[Growth] = ()
    differences: Sequence[Change] = ()
    optima: Sequence[Optimum] = ()


def describe(sweep: Sweep, rows: Sequence[Row], along: AxisStatistics = AxisStatistics()) -> str:
    """Heading, question and numbers of a sweep of any kind."""
    if sweep.labels:
        numbers = _names(sweep, rows, [c for c in along.differences if c.sweep == sweep.name])
    elif sweep.base:
        numbers = _optima(sweep, [o for o in along.optima if o.sweep == sweep.name])
    elif sweep.has_series:
        names = all_series(rows, sweep.name).get(POINT, [])
        numbers = "".join(_series(sweep, rows, name, along.changes) for name in names)
        numbers += _controls(sweep, rows) + _growth(sweep, along.growth) + _at_best(sweep, along.best)
    else:
        numbers = _curve(sweep, rows, along.changes) + _growth(sweep, along.growth)
    heading = f"<h3>{html.escape(sweep.name.capitalize())}</h3>" if sweep.single_curve else ""
    return (
        f"{heading}<p>{html.escape(sweep.question)} Averaged over {counted(len(sweep.scope), 'dataset')}.</p>{numbers}"
    )


def _at_best(sweep: Sweep, rows: Sequence[BestSteps]) -> str:
    """A line per point of an axis with several numbers of steps, at the point's best number of steps."""
    points: dict[float, dict[str, BestSteps]] = {}
    for row in rows:
        if row.sweep == sweep.name:
            points.setdefault(row.x, {})[row.metric] = row
    if not points:
        return ""
    metrics = list(dict.fromkeys(m for by_metric in points.values() for m in by_metric))
    lines = []
    for x, by_metric in points.items():
        cells = [_with_interval(f) if (f := by_metric.get(m)) else "–" for m in metrics]
        any_of = next(iter(by_metric.values()))
        chosen = any_of.chosen + (" (an end of the grid)" if any_of.edge else "")
        lines.append([f"{x:,}", *cells, str(any_of.seeds), chosen])
    head = [sweep.axis, *(METRICS[m].heading for m in metrics), "seeds", "steps chosen, and how often"]
    return (
        "<h4>At the best number of steps for each point</h4>"
        + table(head, lines)
        + (
            "<p>Steps are chosen by the loss on one half of every robot's episodes and judged on the other half, and the "
            "other way round: judged on the windows that chose it, the lowest of several losses would be too low. Where an "
            "end of the grid was chosen, other numbers of steps may be better still. Intervals of 95 % are over seeds and "
            "episodes.</p>"
        )
    )


def _growth(sweep: Sweep, rows: Sequence[Growth]) -> str:
    """A line per step from one cap to the next, per curve and per group of robots."""
    steps: dict[tuple[str, float, float, str], dict[str, Growth]] = {}
    for row in rows:
        if row.sweep == sweep.name:
            steps.setdefault((row.series, row.first, row.last, row.data), {})[row.metric] = row
    if not steps:
        return ""
    metrics = list(dict.fromkeys(m for by_metric in steps.values() for m in by_metric))
    lines = []
    for (series, first, last, data), by_metric in steps.items():
        cells = [_with_interval(f, "+") if (f := by_metric.get(m)) else "–" for m in metrics]
        any_of = next(iter(by_metric.values()))
        whose = f"{any_of.robots} with more" if data == GROWS else f"{any_of.robots} with no more"
        lines.append([html.escape(series), f"{first:,} to {last:,}", whose, *cells, str(any_of.seeds)])
    head = ["curve", sweep.axis, "robots", *(METRICS[m].heading for m in metrics), "seeds"]
    return (
        "<h4>Robots whose data grows, and others</h4>"
        + table(head, lines, text=3)
        + (
            "<p>Changes from each point to the next, paired by window: of robots that have more trajectories there, and of "
            "robots whose data is exhausted. Intervals of 95 % are over episodes, and over seeds where there are several."
            "</p>"
        )
    )


def _columns(sweep: Sweep, rows: Sequence[Row], role: str = POINT) -> dict[str, dict[float, CurvePoint]]:
    """{metric: {x: point}} of the metrics that exist, as `choose_metrics` chooses."""
    measured = {r.metric for r in rows if r.sweep == sweep.name}
    metrics = choose_metrics([m for m in COLUMNS if m in measured], [HELD_OUT_LOSS, *USUAL])
    return {m: {p.x: p for p in curve(rows, sweep.name, m, role, robots_vary=sweep.robots_vary)} for m in metrics}


def _series(sweep: Sweep, rows: Sequence[Row], name: str, changes: Sequence[Change]) -> str:
    """The numbers of one curve of several, as if the sweep had only this curve."""
    own = [r for r in rows if r.sweep == sweep.name and r.series == name and not r.of_robot]
    own = [dataclasses.replace(r, series="") for r in own]
    return f"<h4>{html.escape(name)}</h4>{_curve(sweep, own, changes, name)}" if own else ""


def _controls(sweep: Sweep, rows: Sequence[Row]) -> str:
    """The trials on shuffled actions, beside all curves of several."""
    lines = _lines(sweep, rows, CONTROL)
    heading = f"{sweep.beside_controls}, shuffled actions" if sweep.beside_controls else "Trained on shuffled actions"
    return f"<h4>{html.escape(heading)}</h4>{_table(sweep, rows, lines)}" if lines else ""


def _curve(sweep: Sweep, rows: Sequence[Row], changes: Sequence[Change], series: str = "") -> str:
    """A line per point, one per point on shuffled actions, and the change from end to end."""
    lines = _lines(sweep, rows) + _lines(sweep, rows, CONTROL, ", shuffled actions")
    own = [c for c in changes if (c.sweep, c.series) == (sweep.name, series)]
    return _table(sweep, rows, lines) + _change(own, sweep.robots_vary)


def _table(sweep: Sweep, rows: Sequence[Row], lines: Sequence[Sequence[str]]) -> str:
    """`lines` of `_lines`."""
    return _with_parameters([sweep.axis, *(METRICS[m].heading for m in _columns(sweep, rows)), "seeds"], lines)


def _with_parameters(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table of `lines`, whose last cells are numbers of parameters. These stand last, since a phone shows only the
    first columns; where all are equal, a sentence below the table says them."""
    distinct = {parameters for *_, parameters in lines if parameters}
    if len(distinct) != 1:
        return table([*head, "parameters, all robots"], lines)
    return (
        table(head, [cells for *cells, _ in lines])
        + f"<p>All have {distinct.pop()} parameters, all robots together.</p>"
    )


def _lines(sweep: Sweep, rows: Sequence[Row], role: str = POINT, remark: str = "") -> list[list[str]]:
    """A line of a table for each point of one curve, its parameters at the end."""
    columns, lines = _columns(sweep, rows, role), []
    for x in sorted({x for column in columns.values() for x in column}):
        here = [column.get(x) for column in columns.values()]
        known = next(p for p in here if p)
        values = [pm(p.mean, p.sem) if p else "–" for p in here]
        lines.append([f"{x:,}{remark}", *values, str(len(known.seeds)), _parameters(known)])
    return lines


def _parameters(point: CurvePoint) -> str:
    """The number of parameters, or a range from fewest to most: in designs over robots each seed has its own robots."""
    return " to ".join(f"{n:,}" for n in dict.fromkeys((point.parameters[0], point.parameters[-1])))


def _change(changes: Sequence[Change], robots_vary: bool) -> str:
    """One sentence: what changes from one end of a curve to the other, window by window."""
    if not changes:
        return ""
    ends = changes[0]
    differences = ", ".join(f"{METRICS[c.metric].heading} {_with_interval(c, '+', '95 % interval ')}" for c in changes)
    over = (
        OVER[robots_vary].replace("seeds", f"seeds ({ends.seeds})")
        if ends.seeds > 1
        else "episodes of one seed and leaves out the scatter of seeds"
    )
    known = any(math.isfinite(c.low) for c in changes)
    interval = f"The interval is over {over}." if known else "One held-out episode per robot gives no interval."
    return f"<p>From {ends.first:,} to {ends.last:,}, paired by window: {differences}. {interval}</p>"


def _with_interval(estimate: BestSteps | Change | Growth, sign: str = "", words: str = "") -> str:
    """'0.31 (`words`0.22 to 0.4)', or the mean alone if its error is unknown; `sign`: "+" to put a sign before every
    value."""
    low, high = (f"{end:{sign}.3g}" for end in (estimate.low, estimate.high))
    interval = f" ({words}{low} to {high})" if math.isfinite(estimate.low) else ""
    return f"{estimate.mean:{sign}.3g}{interval}".replace("-", "\u2212")


def _names(sweep: Sweep, rows: Sequence[Row], differences: Sequence[Change]) -> str:
    """A line per variant with its difference from the default; none for the perplexity, which single windows do not
    have."""
    columns = _columns(sweep, rows)
    apart = {(c.metric, c.last): c for c in differences}
    controls = {m: list(column.values()) for m, column in _columns(sweep, rows, CONTROL).items()}
    lines, seeds = [], {}
    for x, label in enumerate(sweep.labels):
        here = {m: column.get(x) for m, column in columns.items()}
        known = next((p for p in here.values() if p), None)
        if known is None:
            continue
        seeds[x] = set(known.seeds)
        cells = [_bold(label, x == sweep.reference_x)]
        for metric, p in here.items():
            cells.append(pm(p.mean, p.sem) if p else "–")
            if metric != "perplexity":
                cells.append(_difference(p, columns[metric].get(sweep.reference_x), apart.get((metric, x))))
        lines.append([*cells, str(len(known.seeds)), _parameters(known)])
    if any(controls.values()):
        cells = []
        for metric, points in controls.items():
            cells += [pm(points[0].mean, points[0].sem) if points else "–", *[""] * (metric != "perplexity")]
        lines.append(["default, shuffled actions", *cells, "1", ""])
    head = [sweep.axis]
    for metric in columns:
        head += [METRICS[metric].heading, *["minus the default"] * (metric != "perplexity")]
    unequal = any(own != seeds.get(sweep.reference_x, own) for own in seeds.values())
    shared = (
        " Where a variant and the default have different seeds (column seeds), the difference is over the seeds that both "
        "have, and not that of the two means."
    ) * unequal
    over, whose = "seeds and episodes, of one seed over episodes alone", ""
    if sweep.robots_vary:
        over = "seeds, each of which evaluates robots of its own"
        whose = (
            " The default trained on shuffled actions has one seed and its robots: do not compare it with the means."
        )
    return _with_parameters([*head, "seeds"], lines) + (
        f"<p>Bold: the default. Differences are paired by seed and window.{shared} Errors are standard errors over {over}."
        f"{whose * any(controls.values())}</p>"
    )


def _bold(text: str, wanted: bool) -> str:
    return f"<b>{html.escape(text)}</b>" if wanted else html.escape(text)


def _difference(point: CurvePoint | None, default: CurvePoint | None, paired: Change | None) -> str:
    """The difference, without an error if trials kept no numbers of their windows."""
    if point is None or default is None or point is default:
        return ""
    mean, error = (paired.mean, paired.sem) if paired else (difference(point, default)[0], math.nan)
    if not math.isfinite(mean):  # no seed in common
        return "–"
    return ("+" if mean > 0 else "") + pm(mean, error)


def _optima(sweep: Sweep, optima: Sequence[Optimum]) -> str:
    """A line per curve and loss: where it is lowest and what the base width's best rate costs."""
    lines = [
        [
            ROLES[o.role],
            _bold(o.series, o.series == sweep.base),
            LOSSES[o.metric],
            f"{o.x:.3g}" + (f" <span class=failed>{o.edge}</span>" if o.edge else ""),
            "" if o.near_low == o.near_high else f"{o.near_low:.3g} to {o.near_high:.3g}",
            _moved(o.moved),
            pm(o.loss, o.seed_sem),
            "–" if math.isnan(o.transferred_x) else f"{o.transferred_x:.3g}",
            _penalty(o),
        ]
        for o in optima
    ]
    kind = "width" if sweep.name == "lr" else "curve"
    head = ["", "curve", "loss", "best rate", "as good", "steps moved", "lowest", f"base {kind}'s best rate", "penalty"]
    return (
        f"<p>{_transfer(optima, kind)}</p>"
        + table(head, lines, text=3)
        + (
            "<p><em>As good</em>: rates around the best that the seeds cannot tell from it (95 %, one side, paired; of a rate "
            "whose seeds scatter more than those of the curve's median rate, the median error counts). <em>Steps moved</em>: "
            f"how many steps of the grid the best rate is from that of the base {kind} (bold). <em>Penalty</em>: by how much "
            f"the loss is higher at the best rate of the base {kind}; of the held-out loss, in nats per token; the mean over "
            "seeds, and the lowest to the highest of them. Where all rates of both curves have several seeds in common, both "
            "rates are chosen on all seeds but one and judged on the one left out, so that they may be others than those of "
            "the table; elsewhere they are judged on the seeds that chose them, which makes the penalty too large. The error "
            "of the lowest loss is over seeds; the grid is not interpolated. <em>Edge</em>: the best rate, or one as good, "
            "is the lowest or the highest tried, so the true optimum may lie beyond. <em>Open</em>: so it may on a side where no "
            "rate is told to be worse, since one there has one seed or no result.</p>"
        )
    )


def _transfer(optima: Sequence[Optimum], kind: str) -> str:
    """How far the best rate moves from that of the base `kind`, with muP and without, on held-out data."""
    parts = []
    for role, words in ROLES.items():
        own = [o for o in optima if o.role == role and o.metric == "cross_entropy" and not math.isnan(o.moved)]
        if own:
            far = max(own, key=lambda o: abs(o.moved))
            # Any that reaches an end: the true best beyond it may have moved further than `far`.
            reaches = ", some at an end of the grid or not told from it, so perhaps further"
            open_ended = reaches if any(o.edge for o in own) else ""
            alone = [math.isnan(o.seed_sem) for o in own]
            if any(alone):
                open_ended += f", {'all' if all(alone) else 'some'} told by one seed only, so perhaps less or more"
            steps = counted(round(abs(far.moved)), "step")
            span = counted(round(max(o.moved for o in own) - min(o.moved for o in own)), "step")
            parts.append(
                f"{words}: the best rate of {len(own)} {kind}s is at most {steps} from that of the base {kind}, and "
                f"moves by {span} in all{open_ended}"
            )
    return f"{'; '.join(parts)} (held-out loss)." if parts else ""


def _moved(steps: float) -> str:
    return "–" if math.isnan(steps) else f"{steps:+.0f}".replace("-", "\u2212") if steps else "0"


def _penalty(optimum: Optimum) -> str:
    if math.isnan(optimum.penalty):
        return "–"
    if math.isinf(optimum.penalty):
        return "diverged"
    mean, low, high = (f"{x:z.3f}" for x in (optimum.penalty, optimum.penalty_low, optimum.penalty_high))
    return (mean if low == high else f"{mean} ({low} to {high})").replace("-", "\u2212")
