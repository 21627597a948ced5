"""The page of a judgement: scatter plot, tables, clips side by side. Self-contained HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

from experiments.applications.judging.agreement import LEAST_POLICIES, LEAST_STARTS, count_interval
from experiments.applications.judging.judge import Judgement
from experiments.applications.judging.outcomes import HEAD, LEARNED, SHUFFLED, STATE, TRUE, successes
from experiments.applications.judging.recordings import LAST
from experiments.applications.judging.summary import CONTROL, MODEL, REAL, REFERENCE, shown
from experiments.report.clips import animate
from experiments.report.pieces import STILL, moving, picture, section, table
from experiments.report.plot_style import INK, MUTED, STYLE, save
from experiments.report.style import CSS
from hma_jax.runtime.files import write_file

CLIPS = 6
"""Episodes that are shown."""

COLOURS = {
    "cloned": ("blue: cloned", "#2b5c8a"),
    "diffusion": ("orange: diffusion policies", "#b3541e"),
    "own": ("green: your own", "#2f7d4f"),
    "": ("grey: others", MUTED),
}
"""Kind of a policy, by how its name begins -> how the caption names it, and its colour."""

CORNERS = ((4, 4), (-4, 4), (4, -4), (-4, -4))
"""Where a name may stand beside its point, in printer's points."""

NEAR = 7
"""Pixels from another policy's point within which a name could be taken for that one's."""

MANY_BEYOND = 0.1
"""A policy of which more than this share of actions is clipped may mean them in other units."""


AXES = {
    REFERENCE: "success in the true simulator, by its state",
    REAL: "success of the real robot",
    CONTROL: "success in the control: actions of other episodes, by the head",
}
"""Labels of the horizontal axis."""


def draw_scatter(summary: dict[str, Any], path: Path) -> None:
    """Success in the learned world, and in the control, against the reference (the true simulator or the real robot), a
    point for each policy; without a reference, against each other."""
    across, titles = (
        summary["compared with"] or CONTROL,
        {MODEL: "learned model", CONTROL: "control: actions of other episodes"},
    )
    upwards = [column for column in titles if column != across]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(upwards), figsize=(4.8 * len(upwards), 4.7), sharex=True, sharey=True, squeeze=False
        )
        labels: list[dict[str, Annotation]] = []
        kinds = {name: "own" if name in summary["own"] else name.split("-")[0] for name in summary["policies"]}
        kinds = {name: kind if kind in COLOURS else "" for name, kind in kinds.items()}
        for panel, column in zip(panels[0], upwards, strict=True):
            panel.plot([0, 1], [0, 1], color=MUTED, linewidth=1, zorder=1)
            words = {}
            for name, rates in summary["policies"].items():
                x, y = rates[across], rates[column]
                if x["mean"] is None:  # not counted on the real robot
                    continue
                spread = (
                    [[x["mean"] - x["low"]], [x["high"] - x["mean"]]],
                    [[y["mean"] - y["low"]], [y["high"] - y["mean"]]],
                )
                panel.errorbar(
                    x["mean"], y["mean"], xerr=np.maximum(spread[0], 0), yerr=np.maximum(spread[1], 0), fmt="o",
                    color=COLOURS[kinds[name]][1], elinewidth=0.8, markersize=5,
                )  # fmt: skip
                words[name] = panel.annotate(
                    name, (x["mean"], y["mean"]), CORNERS[0], textcoords="offset points", fontsize=7, color=INK,
                    path_effects=[withStroke(linewidth=2, foreground="white")],  # lines of intervals run below it
                    in_layout=False,
                )  # fmt: skip
            panel.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), title=titles[column], xlabel=AXES[across])
            labels.append(words)
        panels[0, 0].set_ylabel("success in the model, by the head")
        legend = (words for kind, (words, _) in COLOURS.items() if kind in kinds.values())
        figure.supxlabel(f"lines: 95 % intervals; {', '.join(legend)}", fontsize=8.5, color=MUTED)
        figure.tight_layout()
        figure.canvas.draw()
        for panel, words in zip(panels[0], labels, strict=True):
            place(sorted(words.values(), key=lambda word: word.get_text() not in summary["own"]), panel)
        save(figure, path)


def place(words: Sequence[Annotation], panel: Axes) -> None:
    """Moves each name to a corner of its point where it comes near no other point and covers no name before it, and
    hides it where there is none: the table has all names."""
    points = panel.transData.transform([word.xy for word in words])
    kept: list[Bbox] = []
    for word, own in zip(words, points, strict=True):
        taken = kept + [Bbox(at + [[-NEAR], [NEAR]]) for at in points if (at != own).any()]
        for across, up in CORNERS:
            word.xyann = across, up
            word.set(ha="left" if across > 0 else "right", va="bottom" if up > 0 else "top")
            box = word.get_window_extent()
            if all(map(panel.bbox.contains, *box.corners().T)) and not any(map(box.overlaps, taken)):
                kept.append(box)
                break
        else:
            word.set_visible(False)


def describe_clipping(summary: dict[str, Any]) -> str:
    """A warning that names the user's policies of which many actions were clipped; "" where there is none."""
    shares = {name: summary["actions beyond the range"][name] for name in summary["own"]}
    many = [f"{name} ({share:.0%})" for name, share in shares.items() if share > MANY_BEYOND]
    if not many:
        return ""
    return (
        f"Many actions lay outside what {summary['robot']} was ever given, and were clipped to it: of {', '.join(many)}. "
        "Are they raw, in the units of its recordings?"
    )


def write_page(judged: Judgement, summary: dict[str, Any], out: Path, command: str) -> Path:
    """OUT/judge.html, from the figures drawn already."""
    columns = list(next(iter(summary["policies"].values())))
    lines = [[html.escape(name), *(shown(rates[c]) for c in columns)] for name, rates in summary["policies"].items()]
    picks, left = _left_of(judged)
    body = [
        f"<h1>{html.escape(summary['robot'])}: {html.escape(summary['task'])}</h1>",
        f"<p class=lead>{len(lines)} policies, {summary['starts']} starts, {summary['frames']} frames; an episode "
        f"succeeds when the goal is reached at {summary['hold']} frames in a row. In brackets intervals of 95 %.</p>",
        picture(out / "scatter.png", "Success by policy, of which the table below has the numbers"),
        section("Success by policy", table(["policy", *columns], lines), *_doubts(summary)),
        _agreement(summary),
        _head(summary),
        section(f"The same start, {left} on the left, the model on the right", _clips(judged, *picks)),
        section("How to repeat it", f"<pre>{html.escape(command)}</pre>"),
    ]
    path = out / "judge.html"
    write_file(path, (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>hma judge: {html.escape(summary["robot"])}</title>'
        f"<style>{CSS}</style></head>\n<body><main>{''.join(body)}</main></body></html>\n"
    ))  # fmt: skip
    return path


def _doubts(summary: dict[str, Any]) -> list[str]:
    return [
        f"<p><b>{html.escape(warning)}</b></p>"
        for warning in (
            describe_control(summary),
            describe_clipping(summary),
            describe_few_policies(summary),
            describe_few_starts(summary),
            describe_one_apart(summary),
        )
        if warning
    ]


NOTHING = (
    "The rates are compared with nothing outside the model: there is no true simulator, and no success counts of the real "
    "robot were given (--real). They come from the model and from the success head on its frames; either may be wrong, most "
    "of all for a policy that goes where no recording went. If a policy does as well in the control, where another "
    "episode's actions are executed, its success does not come from its actions."
)


def _agreement(summary: dict[str, Any]) -> str:
    if not summary["agreement"]:
        return section("No reference", f"<p><b>{html.escape(NOTHING)}</b></p>")
    measures = list(next(iter(summary["agreement"].values()))["starts"])
    agreed = [
        [html.escape(name), html.escape(over), *(shown(agreement[over][m]) for m in measures)]
        for name, agreement in summary["agreement"].items()
        for over in agreement
    ]
    heading = table(["compared", "interval over other", *measures], agreed, text=2)
    if summary["compared with"] == REAL:
        return section(
            "Agreement with the real robot",
            heading,
            f"<p>Over the {len(_compared(summary))} policies with counts of the robot, whose rates are known as well as these "
            "counts tell.</p>",
        )
    return section(
        "Agreement with the true simulator",
        heading,
        "<p>Share of episodes, by policy and start, with the same outcome in the model and in the true simulator: "
        + "; ".join(f"{html.escape(name)} {shown(x)}" for name, x in summary["episodes alike"].items())
        + ".</p>",
    )


def _head(summary: dict[str, Any]) -> str:
    rates = ", ".join(f"{world} {rate:g}" for world, rate in summary["episodes per second"].items())
    return section(
        "The success head",
        f"<p>{html.escape(describe_head(summary))} {html.escape(describe_recorded_head(summary['head']))}</p>"
        f"<p>Episodes per second, beside whatever else the machine did: {html.escape(rates)}.</p>",
    )


def describe_head(summary: dict[str, Any]) -> str:
    """A sentence on the accuracy of the success head, or of the user's function, on held-out episodes."""
    measured = summary["head"]
    usual = max(measured["positive"], 1 - measured["positive"])
    doubt = "" if measured["frame accuracy"] > usual else " It is no better than that: do not trust the rates."
    return (
        f"{'That of the file with the policies. ' if summary['own success'] else ''}"
        f"On {measured['episodes']:.0f} recorded {'' if 'successes' in measured else 'true '}episodes that no head was "
        f"trained on: accuracy of frames {measured['frame accuracy']:.3f}, AUROC {measured['frame AUROC']:.3f}, accuracy of "
        f"episodes {measured['episode accuracy']:.3f}. The more frequent label is right for {usual:.3f} of the frames.{doubt}"
    )


def describe_control(summary: dict[str, Any]) -> str:
    """A warning that success in the model may not depend on the policies' actions; "" where it is known to."""
    above = summary["above the control"]
    if above["low"] > 0:
        return ""
    return (
        "It is not known that policies succeed more often in the model than in the control, where another episode's actions "
        f"are executed: the difference is {shown(above)} on average over policies. If there is none, the rates do not show "
        "what policies do, whatever they are compared with, or all starts are alike: look at the clips."
    )


def describe_few_policies(summary: dict[str, Any]) -> str:
    """A warning that the agreement is that of few policies; "" where these are enough, or nothing is compared."""
    compared = _compared(summary)
    if not compared or len(compared) >= LEAST_POLICIES:
        return ""
    return (
        f"Only {len(compared)} policies are compared: how well they are told apart says little about others. Correlations and "
        f"rank violation have an interval over other policies from {LEAST_POLICIES} on, correlations a value from 3."
    )


def describe_few_starts(summary: dict[str, Any]) -> str:
    """Why there are no intervals over starts; "" where there are, or nothing is compared."""
    if not summary["compared with"] or summary["starts"] >= LEAST_STARTS:
        return ""
    return (
        f"Correlations and rank violation have an interval over other starts from {LEAST_STARTS} starts on; these are "
        f"{summary['starts']}."
    )


def describe_one_apart(summary: dict[str, Any]) -> str:
    """Why Spearman's correlation has no interval over starts where only it has none; "" elsewhere."""
    if summary["starts"] < LEAST_STARTS:
        return ""
    spearmans = {name: agreed["starts"]["spearman"] for name, agreed in summary["agreement"].items()}
    without = [name for name, x in spearmans.items() if x["mean"] is not None and x["low"] is None]
    if not without:
        return ""
    return (
        f"Over other starts Spearman's correlation has no interval in: {', '.join(without)}. There the rate of one policy is "
        "far from all others, and would be taken for their order."
    )


def _compared(summary: dict[str, Any]) -> list[str]:
    """Policies with a rate outside the model."""
    column = summary["compared with"]
    return [name for name, rates in summary["policies"].items() if column and rates[column]["mean"] is not None]


def describe_recorded_head(measured: dict[str, float]) -> str:
    """Sentences on the accuracy of a head that learnt from recordings, on held-out ones; "" for other heads."""
    if "successes" not in measured:
        return ""
    n, good = round(measured["episodes"]), round(measured["successes"])
    correct = round(measured["successes told"]), round(measured["failures told"])
    accuracy, usual = count_interval(sum(correct), n), max(good, n - good) / n
    doubt = "" if accuracy.low > usual else " So few do not show that it is better: do not trust the rates."
    learnt = (
        f"It was trained on {measured['learnt from']:.0f} recordings, {measured['successes among them']:.0f} of them successes; "
        if "learnt from" in measured
        else "Of the recordings "
    )
    taken = (
        " No recording says at which frames its goal is reached. Assumed is that no frame of a failure shows it, none of the "
        f"first half of a success, and each of the last {measured[LAST]:.0f} of a success. Where a failure passes its goal, or "
        "a success reaches it early, the head was trained on wrong labels; rewards of every step (--reward) avoid this."
        if LAST in measured
        else ""
    )
    return (
        f"It recognises {correct[0]} of {good} successes and {correct[1]} of {n - good} failures: {accuracy.mean:.2f} "
        f"({accuracy.low:.2f} to {accuracy.high:.2f}) of all, {measured['episode accuracy, decoded']:.2f} of them as the "
        f"model's tokenizer decodes them. The more frequent outcome is right for {usual:.2f} of them.{doubt} {learnt}"
        f"left out were {measured['unknown']:.0f} that do not say whether they succeeded, and {measured['too short']:.0f} that are too short.{taken}"
    )


def _left_of(judged: Judgement) -> tuple[tuple[tuple[str, str], ...], str]:
    """The worlds and judges of the clips shown side by side, (world, judge) of each, and the name of the left one."""
    if TRUE in judged.worlds:
        return ((TRUE, STATE), (LEARNED, HEAD)), "the true world"
    return ((SHUFFLED, HEAD), (LEARNED, HEAD)), "the control, which executes another episode's actions,"


CALLED = {TRUE: "true", LEARNED: "model", SHUFFLED: "control"}


def _clips(judged: Judgement, *sides: tuple[str, str]) -> str:
    """Clips of policies spread over the ladder, one start each, with what the judges said."""
    chosen = np.unique(np.linspace(0, len(judged.policies) - 1, CLIPS).round().astype(int))
    successes_by_side = [successes(judged.outcomes, judged.policies, *side) for side in sides]
    figures = []
    for rank, p in enumerate(chosen):
        name, start = judged.policies[p], rank % judged.config.starts
        clips = [judged.rollouts(name, world).images[start] for world, _ in sides]
        words = "".join(
            f"<span>{CALLED[world]}: {'success' if succeeded[p, start] else 'failure'} by {judge}</span>"
            for succeeded, (world, judge) in zip(successes_by_side, sides, strict=True)
        )
        figures.append(
            f"<figure class=trio><figcaption>{html.escape(name)}, start {start}</figcaption>"
            f"{moving(animate(clips, 1), f'{name}, start {start}', '')}<div>{words}</div></figure>"
        )
    return f"{STILL}<div class=trios>{''.join(figures)}</div>"
