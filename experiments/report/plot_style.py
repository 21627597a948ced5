"""What all figures have in common: colours, metrics and their axes, saving."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, NullLocator

from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.rows import OVERALL, UNTRAINED, CurvePoint, Row, curve, of_sweep, tally
from experiments.sweeps.sweep import POINT, Sweep
from hma_jax.runtime.files import write_file

INK, MUTED, GRID = "#22262b", "#6f7780", "#e4e7ea"
COLOURS = {"perplexity": "#2b5c8a", "delta_psnr": "#b3541e"}
COLOURS |= dict.fromkeys(("diffusion_loss", "action_error"), COLOURS["perplexity"])  # in place of it, never beside it
DEFAULT = "#6b3fa0"
"""Colour of the variant that the presets use, as in the paper's figure 5."""
LABELS = {
    "perplexity": "perplexity: exp of the mean nats",
    "diffusion_loss": "diffusion loss",
    "delta_psnr": "ΔPSNR, last frame (dB)",
    "action_error": "squared error of actions (variances)",
}
"""The metrics that are drawn, where there are any."""
USUAL = ["perplexity", "delta_psnr"]
ON_LOG = ("perplexity", "diffusion_loss")
"""Metrics that have a logarithmic axis."""
EXP_OF = {"perplexity": HELD_OUT_LOSS}
"""{what is drawn: the metric of which it is exp of the mean}. The release's perplexity, which tables have, is a mean of
exponentials: of a few hard robots, so that it may rank models otherwise than nats do."""
HIGHEST_DRAWN = 100.0
"""Nats beyond which a trial's exp is left out of figures: beside it, nothing else on an axis could be told apart, and
from 710 on a float does not hold it. Chance is about ten."""
OVER = {False: "seeds and episodes", True: "seeds, each with its own robots"}
"""What the errors of several seeds are taken over, by whether judged robots are drawn anew for every seed."""
ONE_SEED = "one seed: s.e. over episodes"
CAPTION_LETTERS = 15.5
"""Letters of a caption that fit into an inch."""
MARKERS = "o^DvPXs"
SHADES = 0.55
"""Where the colours of curves end on the viridis scale: beyond it they are too light for white paper."""
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
    """The metrics of LABELS that a trial of the sweeps has (latents have a diffusion loss in place of a perplexity),
    as chosen by `choose_metrics`."""
    measured = {r.metric for r in rows if r.sweep in sweeps}
    return choose_metrics([m for m in LABELS if EXP_OF.get(m, m) in measured], USUAL)


def choose_metrics(measured: list[str], usual: list[str]) -> list[str]:
    """Action errors are shown if no frames are predicted; the `usual` metrics while nothing is measured."""
    return [m for m in measured if m != "action_error"] or measured or usual


def drawn_curve(
    rows: Iterable[Row], sweep: Sweep, metric: str, role: str = POINT, scope: str = OVERALL, series: str = ""
) -> list[CurvePoint]:
    """`curve` of a metric in LABELS, as all figures draw it: bars are `sem`. Points with a seed beyond HIGHEST_DRAWN
    are left out, which `show_tally` says."""
    points = curve(rows, sweep.name, EXP_OF.get(metric, metric), role, scope, series, sweep.robots_vary)
    if metric not in EXP_OF:
        return points
    return [_exp(p) for p in points if not any(loss > HIGHEST_DRAWN for loss in p.seeds.values())]


def _exp(p: CurvePoint) -> CurvePoint:
    """The point with exp of its mean and of every seed's mean; errors by the delta method."""
    mean = math.exp(p.mean)
    seeds = {seed: math.exp(value) for seed, value in p.seeds.items()}
    return replace(p, mean=mean, sem=mean * p.sem, seed_sem=mean * p.seed_sem, seeds=seeds)


def show_means(
    panel: Axes, points: Sequence[CurvePoint], xs: Sequence[float], several: str, one: str, **style: Any
) -> None:
    """Means at `xs` with their standard errors, joined by a line; hollow for a single seed, whose error lacks the
    scatter of seeds and would look smallest. `several` and `one` are the legend's names for the two kinds."""
    line = {name: style[name] for name in ("color", "zorder")} | {"linewidth": style.pop("linewidth")}
    panel.plot(xs, [p.mean for p in points], **line)
    for label, face, alone in ((several, style["color"], False), (one, "white", True)):
        own = [(x, p) for x, p in zip(xs, points, strict=True) if (len(p.seeds) == 1) == alone]
        if own:
            panel.errorbar(
                [x for x, _ in own], [p.mean for _, p in own], bars_of(p for _, p in own), linestyle="none",
                markerfacecolor=face, label=label, **style,
            )  # fmt: skip


def say_bars(points: Collection[CurvePoint], robots_vary: bool, what: str = "hollow", training: bool = False) -> str:
    """What the bars of `points` are; `what` shows those of one seed, and `training`: a training loss is among them."""
    alone = [len(p.seeds) == 1 for p in points]
    if alone and all(alone):
        return in_unit(f"bars, {ONE_SEED}" + ", of the training loss over steps" * training, points)
    several = f"bars: s.e. over {OVER[robots_vary]}" + ", of the training loss over seeds" * training
    one = f"; {what}: one seed, over episodes" + " or steps" * training
    return in_unit(several + one * any(alone), points)


def in_unit(words: str, points: Iterable[CurvePoint]) -> str:
    """`words` about errors over episodes; 'windows' replaces 'episodes' unless the errors of `points` are clustered."""
    return words if all(p.clustered for p in points) else words.replace("episodes", "windows")


def show_caption(figure: plt.Figure, words: str) -> None:
    """Puts a caption below all panels, with its lines broken as needed: a longer line would be cut off at both
    edges."""
    room = int(CAPTION_LETTERS * figure.get_figwidth())
    lines = [part for line in words.split("\n") for part in textwrap.wrap(line, room)]
    figure.supxlabel("\n".join(lines), fontsize=8.5, color=MUTED)


def bars_of(points: Iterable[CurvePoint]) -> list[float]:
    """Standard errors, 0 if they are unknown."""
    return [p.sem if p.sem > 0 else 0.0 for p in points]


def style_of(i: int, count: int) -> dict[str, Any]:
    """Colour and marker of one of `count` curves."""
    return dict(color=plt.cm.viridis(SHADES * i / max(count - 1, 1)), marker=MARKERS[i % len(MARKERS)])


def dodge(xs: Sequence[float], i: int, count: int, ends: Sequence[float]) -> list[float]:
    """`xs` moved a little aside, for one of `count` curves on a log axis between `ends`, so that bars do not hide each
    other."""
    if min(ends) <= 0:
        return list(xs)
    factor = (max(ends) / min(ends)) ** (0.01 * (i - (count - 1) / 2))
    return [x * factor for x in xs]


def save(figure: plt.Figure, path: Path) -> None:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=160, metadata={"Software": None})
    plt.close(figure)
    write_file(path, content.getvalue())


class LogTicks(Locator):
    """Three to nine ticks: at the fewest round numbers of each decade, or evenly spaced numbers, that give a tick near
    each end of the axis; on a long axis at every second or third decade, and so on."""

    DECADES = ((1,), (1, 3), (1, 2, 5), (1, 2, 3, 5), (1, 1.5, 2, 3, 4, 5, 7))
    NEAR = 0.2  # as a share of the axis's length

    def __call__(self):
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, vmin: float, vmax: float):
        low, high = sorted((vmin, vmax))
        powers = [10.0**e for e in range(math.floor(math.log10(low)), math.ceil(math.log10(high)))]
        decades = ([m * power for power in powers for m in (*subs, 10)] for subs in self.DECADES)
        sparse = ([p for p in powers if round(math.log10(p)) % n == 0] for n in range(2, len(powers) // 2))
        even = (MaxNLocator(nbins=n, steps=(1, 2, 2.5, 5, 10), min_n_ticks=3) for n in range(6, 9))
        linear = (place.tick_values(low, high) for place in even if high < 10 * low)
        each = (sorted({*ticks}) for ticks in (*decades, *sparse, *linear))
        each = ([t for t in ticks if low <= t <= high] for ticks in each)
        each = [ticks for ticks in each if 3 <= len(ticks) <= 9]

        def bare(ticks: Sequence[float]) -> float:
            """The longer part beyond the outermost ticks, as a share of the axis's length."""
            return math.log(max(ticks[0] / low, high / ticks[-1])) / math.log(high / low)

        return next((ticks for ticks in each if bare(ticks) <= self.NEAR), None) or min(each, key=bare)


def plain_number(value: float) -> str:
    return f"{value:.10g}"


def count(n: float) -> str:
    """1234567 -> '1.2M'."""
    for unit, size in (("E", 1e18), ("P", 1e15), ("T", 1e12), ("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if n >= 0.9995 * size and n >= 1000:  # a value that rounds to a thousand of a unit is one of the next unit
            return f"{n / size:.3g}{unit}" if n / size >= 100 or n % size == 0 else f"{n / size:.1f}{unit}"
    return f"{n:g}"


def plain_log(panel: Axes, axis: Axis, label: Callable[[float], str] = plain_number) -> None:
    """A log scale for values within a few decades, every tick labelled by a plain number."""
    panel.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(LogTicks())
    axis.set_major_formatter(FuncFormatter(lambda v, _: label(v)))
    axis.set_minor_locator(NullLocator())


def axis_of_points(panel: Axes, xs: Sequence[float], names: Sequence[str], room: float | None = None) -> None:
    """Puts the ticks at the points themselves; `room`: the factor that is left beyond the ends, if it matters. The axis
    is logarithmic unless a point has no logarithm: that point would be left out."""
    if min(xs) > 0:
        panel.set_xscale("log")
        if room:
            panel.set_xlim(min(xs) / room, max(xs) * room)
    panel.set_xticks(xs, names)
    panel.xaxis.set_minor_locator(NullLocator())


def show_control(panel: Axes, points: list[CurvePoint], series: str = "") -> None:
    """Draws the trials on shuffled actions at their positions on the axis, with standard errors; `series`: the curve
    beside which they are drawn. They mostly have one seed beside means over several, so the legend says so."""
    if points:
        words = "shuffled actions" + ", one seed" * all(len(p.seeds) == 1 for p in points)
        panel.errorbar(
            [p.x for p in points], [p.mean for p in points], bars_of(points),
            fmt="s", color=MUTED, markersize=5, markerfacecolor="white", capsize=3, elinewidth=1.2, zorder=2,
            label=f"{series}, {words}" if series else f"trained on {words}",
        )  # fmt: skip


def show_tally(panel: Axes, rows: Sequence[Row], sweep: str) -> None:
    finished, total = tally(rows, sweep)
    judged = [
        r for r in of_sweep(rows, sweep) if (r.metric, r.scope) == (HELD_OUT_LOSS, OVERALL) and r.role != UNTRAINED
    ]
    high = {(r.trial, r.x) for r in judged if r.mean > HIGHEST_DRAWN}
    left_out = f", perplexity of {len(high)} too high to draw" if high else ""
    panel.set_title(f"{finished} of {total} trials{left_out}", loc="right", fontsize=8.5, color=MUTED)


def show_legend(figure: plt.Figure, panels: Iterable[Axes]) -> None:
    """A legend of the lines of `panels`, above all of them: inside a panel it would cover the curves. While trials run,
    the first panel may be empty, or lack lines that others have."""
    shown: dict[str, Artist] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    if shown:
        room = max(0.6 + 0.075 * len(label) for label in shown)  # inches of the longest one
        columns = max(1, min(len(shown), int(figure.get_figwidth() / room)))
        figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=columns)


def name_axis(panel: Axes, name: str) -> None:
    """Puts the axis's name below the panel, broken into as many lines as needed: a longer line would be cut off at the
    figure's edge."""
    panel.set_xlabel(textwrap.fill(name, 44))


def show_nothing(panel: Axes) -> None:
    panel.text(0.5, 0.5, "no finished trial", transform=panel.transAxes, ha="center", color=MUTED)
