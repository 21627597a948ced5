"""The page of a judgement: scatter plot, tables, clips side by side. Self-contained HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

from experiments.applications.judging.judge import Judged
from experiments.applications.judging.outcomes import HEAD, LEARNED, STATE, TRUE, successes
from experiments.applications.judging.summary import COLUMNS, shown
from experiments.report.clips import animate
from experiments.report.pieces import data_uri, picture, section, table
from experiments.report.plot_style import INK, MUTED, STYLE, save
from experiments.report.style import CSS
from hma_jax.runtime.files import write_file

CLIPS = 6
"""Episodes that are shown."""

OWN_COLOUR = "#2f7d4f"

MANY_BEYOND = 0.1
"""A policy of which more than this share of actions is clipped may mean them in other units."""


def draw_scatter(summary: dict[str, Any], path: Path) -> None:
    """Success in the true world against success in the learned one, and in the control, a point for each policy."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(9.6, 4.7), sharex=True, sharey=True)
        labels: list[list[Annotation]] = []
        for panel, column, title in zip(
            panels,
            ("learned, by head", "shuffled, by head"),
            ("learned model", "control: actions of other episodes"),
            strict=True,
        ):
            panel.plot([0, 1], [0, 1], color=MUTED, linewidth=1, zorder=1)
            words = []
            for name, rates in summary["policies"].items():
                x, y = rates["true, by state"], rates[column]
                spread = (
                    [[x["mean"] - x["low"]], [x["high"] - x["mean"]]],
                    [[y["mean"] - y["low"]], [y["high"] - y["mean"]]],
                )
                made = {"cloned": "#2b5c8a", "diffusion": "#b3541e"}.get(name.split("-")[0], MUTED)
                colour = OWN_COLOUR if name in summary["own"] else made
                panel.errorbar(
                    x["mean"], y["mean"], xerr=np.maximum(spread[0], 0), yerr=np.maximum(spread[1], 0), fmt="o",
                    color=colour, elinewidth=0.8, markersize=5,
                )  # fmt: skip
                at = (x["mean"], y["mean"])
                left = x["mean"] > 0.85  # there is no room on the right
                words.append(panel.annotate(
                    name, at, (-4 if left else 4, 4), textcoords="offset points", fontsize=7, color=INK,
                    ha="right" if left else "left",
                ))  # fmt: skip
            panel.set(
                xlim=(-0.03, 1.03),
                ylim=(-0.03, 1.03),
                title=title,
                xlabel="success in the true simulator, by its state",
            )
            labels.append(words)
        panels[0].set_ylabel("success in the model, by the head")
        figure.tight_layout()
        figure.canvas.draw()
        for words in labels:
            thin_out(words)
        save(figure, path)


def thin_out(words: Sequence[Annotation]) -> None:
    """Hides what would be written over another word; the table has all names."""
    kept: list[Bbox] = []
    for word in words:
        box = word.get_window_extent()
        word.set_visible(not any(box.overlaps(other) for other in kept))
        kept += [box] if word.get_visible() else []


def say_beyond(summary: dict[str, Any]) -> str:
    """In words, of which policies of the user's many actions were clipped; "" where of none."""
    shares = {name: summary["actions beyond the range"][name] for name in summary["own"]}
    many = [f"{name} ({share:.0%})" for name, share in shares.items() if share > MANY_BEYOND]
    if not many:
        return ""
    return (
        f"Many actions lay outside what {summary['robot']} was ever given, and were clipped to it: of {', '.join(many)}. "
        "Are they raw, in the units of its recordings?"
    )


def write_page(judged: Judged, summary: dict[str, Any], out: Path, command: str) -> Path:
    """OUT/judge.html, from the figures drawn already."""
    measured = summary["head"]
    lines = [[html.escape(name), *(shown(rates[c]) for c in COLUMNS)] for name, rates in summary["policies"].items()]
    measures = list(next(iter(summary["agreement"].values()))["starts"])
    agreed = [
        [html.escape(name), html.escape(over), *(shown(found[over][m]) for m in measures)]
        for name, found in summary["agreement"].items()
        for over in found
    ]
    rates = ", ".join(f"{world} {rate:g}" for world, rate in summary["episodes per second"].items())
    body = [
        f"<h1>{html.escape(summary['robot'])}: {html.escape(summary['task'])}</h1>",
        f"<p class=lead>{len(lines)} policies, {summary['starts']} starts, {summary['frames']} frames; an episode "
        f"succeeds when the goal is reached at {summary['hold']} frames in a row. In brackets intervals of 95 %.</p>",
        picture(out / "scatter.png", "success in both worlds"),
        section("Success by policy", table(["policy", *COLUMNS], lines), f"<p>{html.escape(say_beyond(summary))}</p>"),
        section(
            "Agreement with the true simulator",
            table(["compared", "interval over other", *measures], agreed, text=2),
            "<p>Model and truth say the same of a policy's episode from a start: "
            + "; ".join(f"{html.escape(name)} {shown(x)}" for name, x in summary["episodes alike"].items())
            + ".</p>",
        ),
        section(
            "The success head",
            f"<p>On {measured['episodes']:.0f} recorded true episodes that it was not trained on: accuracy "
            f"of frames {measured['frame accuracy']:.3f}, AUROC {measured['frame AUROC']:.3f}, accuracy of episodes "
            f"{measured['episode accuracy']:.3f}.</p><p>Episodes per second, this machine as loaded as it was: "
            f"{html.escape(rates)}.</p>",
        ),
        section("The same start, the true world on the left, the model on the right", _clips(judged)),
        section("How to repeat it", f"<pre>{html.escape(command)}</pre>"),
    ]
    path = out / "judge.html"
    write_file(path, (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>hma judge: {html.escape(summary["robot"])}</title>'
        f"<style>{CSS}</style></head>\n<body><main>{''.join(body)}</main></body></html>\n"
    ))  # fmt: skip
    return path


def _clips(judged: Judged) -> str:
    """Of policies spread over the ladder, one start each, and what the judges said."""
    chosen = np.unique(np.linspace(0, len(judged.policies) - 1, CLIPS).round().astype(int))
    state = successes(judged.outcomes, judged.policies, TRUE, STATE)
    head = successes(judged.outcomes, judged.policies, LEARNED, HEAD)
    figures = []
    for rank, p in enumerate(chosen):
        name, start = judged.policies[p], rank % judged.config.starts
        clips = [judged.rollouts(name, world).images[start] for world in (TRUE, LEARNED)]
        said = [("success" if x[p, start] else "failure") for x in (state, head)]
        figures.append(
            f"<figure class=trio><figcaption>{html.escape(name)}, start {start}</figcaption>"
            f'<img alt="" src="{data_uri(animate(clips, 1), "webp")}">'
            f"<div><span>true: {said[0]} by state</span><span>model: {said[1]} by head</span></div></figure>"
        )
    return f"<div class=trios>{''.join(figures)}</div>"
