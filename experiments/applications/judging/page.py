"""The page of a judgement: scatter plot, tables, clips side by side. Self-contained HTML."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np

from experiments.applications.judging.doubts import (
    NOTHING,
    compared_policies,
    describe_head,
    describe_recorded_head,
    doubts_of_rates,
    doubts_of_starts,
)
from experiments.applications.judging.judge import Judgement
from experiments.applications.judging.ladder import OWN_HEAD, RANDOM, kind_of
from experiments.applications.judging.outcomes import HEAD, LEARNED, SHUFFLED, STATE, TRUE, successes
from experiments.applications.judging.summary import CONTROL, MODEL, REAL, REFERENCE, shown
from experiments.applications.policies.kinds import KINDS
from experiments.report.clips import animate, strip
from experiments.report.pieces import STILL, moving, picture, section, table
from experiments.report.style import CSS
from hma_jax.runtime.files import write_file

CLIPS = 6
"""Episodes that are shown."""

ON_PAPER = 6
"""Frames of each of them that are printed."""

POLICIES_EXPLAINED = {
    RANDOM: (RANDOM, "draws its actions at random"),
    **{name: (f"{name}-N", f"{kind.explained}, after N training steps") for name, kind in KINDS.items()},
    OWN_HEAD: (OWN_HEAD, "the model itself"),
}
"""Kind of a policy that is not the user's -> its heading, and what it is."""

COLUMNS_EXPLAINED = {
    REAL: "counted on the real robot",
    REFERENCE: "in the true simulator, whose state says whether the goal is reached",
    "true, by head": "the same episodes, as the success head sees them in the frames",
    MODEL: "in the learned model, by the success head",
    CONTROL: "the control: in the learned model, with the actions of another episode, by the success head",
}

MEASURES_EXPLAINED = {
    "pearson": ("Pearson", "correlation of the success rates with the true ones; 1 is best"),
    "spearman": ("Spearman", "correlation of the ranks by success rate with the true ranks; 1 is best"),
    "rank violation": (
        "rank violation",
        "the largest difference in true rate from a policy that is ranked the other way round, on average; 0 is best",
    ),
    "bias": ("bias", "success rate minus the true one, on average over policies; above 0 is too good"),
}
"""Measure of agreement -> its heading, and what it is."""


def write_page(judged: Judgement, summary: dict[str, Any], out: Path, command: str) -> Path:
    """OUT/judge.html, from the figures drawn already."""
    columns = list(next(iter(summary["policies"].values())))
    lines = [[html.escape(name), *(_number(rates[c]) for c in columns)] for name, rates in summary["policies"].items()]
    picks, left = _left_of(judged)
    body = [
        f"<h1>{html.escape(summary['robot'])}: {html.escape(summary['task'])}</h1>",
        f"<p class=lead>{len(lines)} policies, {summary['starts']} starts, {summary['frames']} frames; an episode "
        f"succeeds when the goal is reached at {summary['hold']} frames in a row. In brackets intervals of 95 %.</p>",
        picture(out / "scatter.png", "Success by policy, of which the table below has the numbers"),
        section("Success by policy", table(["policy", *columns], lines), _policies(summary), *_doubts(summary)),
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
    warnings = doubts_of_rates(summary) + doubts_of_starts(summary)
    return [f"<p><b>{html.escape(warning)}</b></p>" for warning in warnings]


def _policies(summary: dict[str, Any]) -> str:
    """What the names of policies and of columns mean."""
    columns = next(iter(summary["policies"].values()))
    kinds = dict.fromkeys(kind_of(name) for name in summary["policies"] if name not in summary["own"])
    policies = _listed(dict(POLICIES_EXPLAINED[kind] for kind in kinds))
    rates = _listed({column: COLUMNS_EXPLAINED[column] for column in columns})
    return f"<p>Policies: {policies}.</p><p>Success rates: {rates}. docs/judging.md says more.</p>"


def _agreement(summary: dict[str, Any]) -> str:
    if not summary["agreement"]:
        return section("No reference", f"<p><b>{html.escape(NOTHING)}</b></p>")
    measures = list(next(iter(summary["agreement"].values()))["starts"])
    agreed = [
        [html.escape(name), html.escape(over), *(_number(agreement[over][m]) for m in measures)]
        for name, agreement in summary["agreement"].items()
        for over in agreement
    ]
    explained = dict(MEASURES_EXPLAINED[m] for m in measures)
    parts = (
        table(["compared", "interval over other", *explained], agreed, text=2),
        f"<p>Over policies: {_listed(explained)}. Intervals over <em>other policies and starts</em> are for policies like "
        "these, those over <em>other starts</em> for these policies alone.</p>",
    )
    if summary["compared with"] == REAL:
        return section(
            "Agreement with the real robot",
            *parts,
            f"<p>Over the {len(compared_policies(summary))} policies with counts of the robot, whose rates are known as well "
            "as these counts tell.</p>",
        )
    return section(
        "Agreement with the true simulator",
        *parts,
        "<p>Share of episodes, by policy and start, with the same outcome in the model and in the true simulator: "
        + "; ".join(f"{html.escape(name)} {_number(x)}" for name, x in summary["episodes alike"].items())
        + ".</p>",
    )


def _listed(explained: dict[str, str]) -> str:
    return "; ".join(f"<em>{html.escape(name)}</em>: {html.escape(words)}" for name, words in explained.items())


def _number(value: dict[str, float | None]) -> str:
    """`shown` with minus signs as they are set in print."""
    return shown(value).replace("-", "\u2212")


def _head(summary: dict[str, Any]) -> str:
    rates = ", ".join(f"{world} {rate:g}" for world, rate in summary["episodes per second"].items())
    return section(
        "The success head",
        f"<p>{html.escape(describe_head(summary))} {html.escape(describe_recorded_head(summary['head']))}</p>"
        f"<p>Episodes per second, beside whatever else the machine did: {html.escape(rates)}.</p>",
    )


def _left_of(judged: Judgement) -> tuple[tuple[tuple[str, str], ...], str]:
    """The worlds and judges of the clips shown side by side, (world, judge) of each, and the name of the left one."""
    if TRUE in judged.worlds:
        return ((TRUE, STATE), (LEARNED, HEAD)), "the true world"
    return ((SHUFFLED, HEAD), (LEARNED, HEAD)), "the control, which executes another episode's actions,"


CALLED = {TRUE: "true", LEARNED: "model", SHUFFLED: "control"}


def _clips(judged: Judgement, *sides: tuple[str, str]) -> str:
    """Clips of policies spread over the ladder, one start each, with what the judges said; for paper as rows of
    frames."""
    chosen = np.unique(np.linspace(0, len(judged.policies) - 1, CLIPS).round().astype(int))
    successes_by_side = [successes(judged.outcomes, judged.policies, *side) for side in sides]
    figures, printed = [], []
    for rank, p in enumerate(chosen):
        name, start = judged.policies[p], rank % judged.config.starts
        title = f"{name}, start {start}"
        clips = [judged.rollouts(name, world).images[start] for world, _ in sides]
        words = [
            f"{CALLED[world]}: {'success' if succeeded[p, start] else 'failure'} by {judge}"
            for succeeded, (world, judge) in zip(successes_by_side, sides, strict=True)
        ]
        captions = "".join(f"<span>{word}</span>" for word in words)
        figures.append(
            f"<figure class=trio><figcaption>{html.escape(title)}</figcaption>"
            f"{moving(animate(clips, 1), title, '')}<div>{captions}</div></figure>"
        )
        some = np.unique(np.linspace(0, len(clips[0]) - 1, ON_PAPER).round().astype(int))
        printed.append(strip(title, {word: clip[some] for word, clip in zip(words, clips, strict=True)}, 1))
    return f"{STILL}<div class=trios>{''.join(figures)}</div><div class=paper>{''.join(printed)}</div>"
