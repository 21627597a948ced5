"""`hma compare`: two models compared window by window, on the windows that both were evaluated on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from tyro.conf import Positional, arg

from experiments.terminal.progress import console, tidy_table, wrote
from experiments.terminal.words import few, plus_minus
from hma_jax.config import require
from hma_jax.evaluation.measures import METRICS, OF_TOKENS, OF_WINDOWS
from hma_jax.runtime.files import write_file
from hma_jax.runtime.outputs import make_directory

if TYPE_CHECKING:
    from rich.table import Table

    from experiments.analysis.compare import Difference, Side

DEFAULT = Path("comparison.csv")


def compare(
    a: Annotated[Positional[Path], arg(metavar="A")],
    b: Annotated[Positional[Path], arg(metavar="B")],
    to: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=f"(default: {DEFAULT})")] = None,
) -> None:
    """Compare two models, or the reference models of two studies, on the windows that both were evaluated on.

    Prints A - B with standard errors, per robot and overall, nats per token first, and writes every metric with
    its 95 % interval. Differences are paired window by window. Standard errors are over episodes and, between studies
    of several seeds, also over seeds. Ends with exit code 2 if the two were not evaluated on the same windows, or
    have no metric in common.

    Args:
        a: Directory of a finished trial, of an evaluated model, or of a study.
        b: Directory of the one to compare it with.
        to: CSV file to write. An existing file is replaced; the default file only by the same comparison.
    """
    from experiments.analysis import compare as analysis
    from experiments.analysis.rows import csv_text
    from experiments.analysis.tables import read_side

    place = to or DEFAULT
    require(not place.is_dir(), f"--to {place} is a directory; name a file, such as --to {place / DEFAULT}")
    make_directory(place.parent, "--to")
    first, second = read_side(a), read_side(b)
    if first.name == second.name:  # as of two runs that are called model
        first, second = replace(first, name=str(a)), replace(second, name=str(b))
    rows = analysis.compare(first, second)
    console.print(_table(rows, first, second))
    text = csv_text(analysis.Difference, rows)
    require(
        to is not None or not place.exists() or place.read_bytes() == text.encode(),
        f"{place} holds another comparison, which is not overwritten. Write this one elsewhere with --to FILE, or "
        f"overwrite that one with --to {place}",
    )
    write_file(place, text)
    wrote(place)


def _table(rows: list[Difference], a: Side, b: Side) -> Table:
    """A line per scope, overall first; differences of the metrics that are shown with their standard errors."""
    from experiments.analysis.intervals import nats_first

    measured = {row.metric for row in rows}
    metrics = nats_first(name for name, metric in METRICS.items() if metric.compared and name in measured)
    found = {(row.scope, row.metric): row for row in rows}
    ratio = "cross_entropy" in metrics
    columns = ["robot", *(_heading(m, ids=ratio) for m in metrics), *["perplexity"] * ratio]
    table = tidy_table(escape(f"{a.name} - {b.name}"), *columns)
    for scope in dict.fromkeys(row.scope for row in rows):
        cells = [_cell(found.get((scope, metric))) for metric in metrics]
        nats = found.get((scope, "cross_entropy"))
        table.add_row(scope, *cells, *([f"x {nats.ratio:.4g}"] if nats else [""] * ratio))
    table.caption = _caption(rows, a, b)
    return table


def _caption(rows: list[Difference], a: Side, b: Side) -> str:
    """What the errors include, whose training differs, and which seeds, robots and metrics were not compared."""
    from experiments.analysis.compare import of_other_tokens, other_sequences

    seeds = max(row.seeds for row in rows)
    over = f" and over {seeds} seeds" if seeds > 1 else ""
    caption = f"Differences with standard errors over episodes{over}, window by window."
    for side, other in ((a, b), (b, a)):
        if len(side.seeds) > seeds:
            all_seeds, common = (
                ", ".join(map(str, x)) for x in (side.seeds, [s for s in side.seeds if s in other.seeds])
            )
            verb = "is" if seeds == 1 else "are"
            caption += f" Of the seeds of {escape(side.name)} ({all_seeds}) only {common} {verb} compared."
            if not other.says_seed:
                unsaid = "does not say with which seed it was trained, and stands for"
                caption += f" {escape(other.name)} {unsaid} {common}."
        robots, other_robots = (next(iter(one.seeds.values())).datasets for one in (side, other))
        if left_out := [name for name in robots if name not in other_robots]:
            caption += f" Only {escape(side.name)} was judged on {few(left_out)}: no value here includes them."
    if len(a.seeds) == len(b.seeds) == 1 and a.says_seed and b.says_seed and a.seeds.keys() != b.seeds.keys():
        of_a, of_b = (f"{escape(side.name)} is of seed {next(iter(side.seeds))}" for side in (a, b))
        caption += f" {of_a}, {of_b}: differences include those between seeds, which no error accounts for."
    known = [side for side in (a, b) if side.step]
    if len({side.step for side in known}) > 1 or any(side.step < side.steps for side in known):
        made = [f"{escape(one.name)} {one.step:,}" + (f" of {one.steps:,}" if one.steps else "") for one in known]
        caption += f" Steps of training when they were evaluated: {', '.join(made)}."
    if alone := list(dict.fromkeys(row.scope for row in rows if row.episodes == 1)):
        caption += f" No error of {few(alone)}: one held-out episode."
    compared = [row.scope for row in rows if row.metric == "action_nats"]
    others = [other_sequences(side, compared) for side in (a, b)]
    if all(others) and others[0] != others[1]:
        of_a, of_b = (" or ".join(map(str, counts)) for counts in others)
        caption += (
            f" Action-nats are over other numbers of sequences: for each window {of_a} of {escape(a.name)}, {of_b} of "
            f"{escape(b.name)}, the longer list beginning with the shorter one."
        )
    explained = {row.metric for row in rows} | set(OF_WINDOWS)
    if why := of_other_tokens(a, b):
        caption += f" {'Losses' if a.noising_steps and b.noising_steps else 'Nats'} are not compared: {why}."
        explained |= set(OF_TOKENS)
    elif not (a.tokenizer and b.tokenizer):
        caption += " Nats are comparable only if both saw the same tokens, which one of them does not say."
    measured = dict.fromkeys(metric for side in (a, b) for table in side.seeds.values() for metric in table.metrics)
    if missing := [metric for metric in measured if metric not in explained]:
        caption += f" Not compared, since not both have them, or among as many actions: {', '.join(missing)}."
    return caption


def _heading(metric: str, ids: bool) -> str:
    """A metric with its unit, if it has one. If tokens are latents, not `ids`, action-nats are in units of the loss."""
    from experiments.analysis.intervals import NATS

    unit = ("nats" if ids else "loss") if metric in NATS else METRICS[metric].unit
    return f"{metric} ({unit})" if unit else metric


def _cell(row: Difference | None) -> str:
    return plus_minus(row.mean, row.sem, "+") if row else ""
