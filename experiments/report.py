"""The report: one HTML page with the curves, frames, tables and everything needed to repeat it.

Self-contained: pictures are embedded, nothing is fetched. Numbers come from the rows of the
CSV; only frames and run records are read from the trials' directories.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.ledger import FINISHED
from experiments.provenance import Provenance
from experiments.report_style import CSS
from experiments.rows import OVERALL, CurvePoint, Row, curve, load_result
from experiments.runner import State
from experiments.sweep import Sweep, reference_trial, unique_trials
from experiments.trial import trial_id
from experiments.workspace import Record, Workspace
from hma_jax.config import to_json

SHOWN_STRIPS = 6
"""Datasets whose frames are visible at once; the others unfold."""

QUESTIONS = {
    "datasets": "Does training on more robots help or hurt those already there? All points are judged "
    "on the smallest set of datasets and see the same number of windows in training.",
    "trajectories": "What does more data per robot buy? Subsets are nested; the number of optimiser "
    "steps is the same everywhere.",
    "width": "What does a wider model buy? The learning rate is set once, at the base width, and "
    "carried over by muP.",
}


def write_report(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    states: dict[str, State],
    provenance: Provenance,
) -> None:
    """Writes workspace.report from `rows` and the figures already drawn."""
    study = record.study
    reference = trial_id(reference_trial(study, study.seeds[0]), provenance)
    finished = states.get(reference, State("missing")).event == FINISHED
    result = load_result(workspace.trials, reference) if finished else None
    prompt = study.eval.prompt_frames
    body = [
        _headline(workspace, record, sweeps, rows, states, result),
        _section("Scaling curves", _picture(workspace.figures / "scaling.png", "Scaling curves"), *(
            _axis(sweep, rows) for sweep in sweeps
        )),
        _section(
            "True and predicted frames", _strips(workspace.trials / reference / "samples.npz", prompt)
        ) if finished else "",
        _section("Reference trial by dataset", _dataset_table(rows, sweeps, workspace)) if finished else "",
        _section("Trials", _trial_table(workspace, sweeps, states, provenance)),
        _section("How to repeat it", _origin(workspace, record, provenance, result)),
    ]  # fmt: skip
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>HMA-JAX scaling study: {html.escape(study.name)}</title><style>{CSS}</style></head>\n"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )
    aside = workspace.report.with_suffix(".tmp")
    aside.write_text(page, encoding="utf-8")
    aside.replace(workspace.report)


# --- Parts -----------------------------------------------------------------------------------


def _headline(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    states: dict[str, State],
    result: dict[str, Any] | None,
) -> str:
    study = record.study
    whole = next((s.name for s in sweeps if s.scope == study.dataset_names()), sweeps[0].name)
    cards = [
        _card("perplexity, reference", _last(curve(rows, whole, "perplexity")), "s.e. over windows and seeds"),
        _card("perplexity, untrained", _last(curve(rows, whole, "perplexity", "untrained")),
              f"vocabulary size is {study.model.vocab_size:,}"),
        _card("ΔPSNR, reference", _last(curve(rows, whole, "delta_psnr")), "dB, last frame: true minus random actions"),
        _card("ΔPSNR, shuffled actions", _last(curve(rows, whole, "delta_psnr", "control")),
              "dB, must vanish within its error"),
        _card("tokenizer PSNR", _tokenizer_quality(workspace), "dB, reconstruction of held-out frames"),
    ]  # fmt: skip
    when = result["run"]["finished"] if result else "reference trial not finished"
    unfinished = sum(state.event != FINISHED for state in states.values())
    warning = f'<p class="warning">{unfinished} trial(s) have no result; see the table of trials.</p>'
    return (
        f"<header><h1>HMA scaling study <em>{html.escape(study.name)}</em></h1>"
        f"<p class=lead>What do more robots, more data and more width buy an action-conditioned video "
        f"model? {len(study.dataset_names())} dataset(s), {study.train.steps:,} steps of "
        f"{study.train.batch} windows per trial, {len(study.seeds)} seed(s).</p>"
        f"<p class=meta>{html.escape(when)}</p></header>"
        f'<div class=cards>{"".join(cards)}</div>{warning if unfinished else ""}'
    )


def _tokenizer_quality(workspace: Workspace) -> CurvePoint | None:
    path = workspace.tokenizer / "quality.json"
    if not path.exists():
        return None
    quality = json.loads(path.read_text())
    return CurvePoint(0, quality["mean"], quality["sem"], (), 0)


def _axis(sweep: Sweep, rows: Sequence[Row]) -> str:
    """The numbers of one curve, and its change from end to end in standard errors."""
    perplexity, delta = curve(rows, sweep.name, "perplexity"), curve(rows, sweep.name, "delta_psnr")
    table = _table(
        [sweep.axis, "parameters", "perplexity", "ΔPSNR (dB)", "seeds"],
        [
            [f"{p.x:,}", f"{p.parameters:,}", _pm(p), _pm(d), str(len(p.seeds))]
            for p, d in zip(perplexity, delta, strict=True)
        ],
    )
    trend = ""
    if len(perplexity) > 1:
        trend = (
            f"<p>From {perplexity[0].x:,} to {perplexity[-1].x:,}: perplexity "
            f"{_change(perplexity)}, ΔPSNR {_change(delta)}.</p>"
        )
    return (
        f"<h3>{html.escape(sweep.name.capitalize())}</h3><p>{html.escape(QUESTIONS.get(sweep.name, ''))} "
        f"Averaged over {len(sweep.scope)} dataset(s).</p>{table}{trend}"
    )


def _strips(path: Path, prompt: int) -> str:
    """Rows of frames per dataset: recorded, predicted, and predicted under random actions."""
    with np.load(path) as samples:
        names = list(dict.fromkeys(key.split("/")[0] for key in samples.files))
        strips = [
            f"<figure class=strip><figcaption>{html.escape(name)}</figcaption>"
            + "".join(
                f"<div><span>{label}</span>{_frames(samples[f'{name}/{kind}'][0], prompt)}</div>"
                for kind, label in (("true", "true"), ("predicted", "predicted"), ("random", "random actions"))
            )
            + "</figure>"
            for name in names
        ]
    rest = "".join(strips[SHOWN_STRIPS:])
    more = f"<details><summary>{len(names) - SHOWN_STRIPS} more datasets</summary>{rest}</details>"
    return (
        f"<p>The first validation window of each dataset. The first {prompt} frames are given; the rest is "
        "predicted from actions alone, once under the recorded actions and once under random ones.</p>"
        f"{''.join(strips[:SHOWN_STRIPS])}{more if rest else ''}"
    )


def _dataset_table(rows: Sequence[Row], sweeps: Sequence[Sweep], workspace: Workspace) -> str:
    """One line per dataset; data.json says how much of it there was."""
    sweep = max(sweeps, key=lambda s: len(s.scope))
    data = json.loads(workspace.data_summary.read_text()) if workspace.data_summary.exists() else {}
    x = next(p.x for p in sweep.points if p.role == "control")  # where the reference trial stands

    def cell(name: str, metric: str) -> str:
        at = [p for p in curve(rows, sweep.name, metric, scope=name) if p.x == x]
        return _pm(at[0]) if at else "–"

    metrics = ("perplexity", "accuracy", "psnr", "psnr_copy", "ssim", "delta_psnr")
    head = ["dataset", "episodes", "too short", "skipped", "windows", "perplexity", "accuracy", "PSNR (dB)",
            "copying (dB)", "SSIM", "ΔPSNR (dB)"]  # fmt: skip
    lines = []
    for name in (*sweep.scope, OVERALL):
        facts = data.get(name, {})
        counts = [str(facts.get(k, "–")) for k in ("episodes", "too_short", "skipped", "windows")]
        lines.append([html.escape(name), *counts, *(cell(name, metric) for metric in metrics)])
    return (
        "<p>PSNR and SSIM are of the rollout against the recorded frames; <em>copying</em> is the PSNR "
        "of repeating the last given frame. Errors are standard errors.</p>" + _table(head, lines)
    )


def _trial_table(
    workspace: Workspace, sweeps: Sequence[Sweep], states: dict[str, State], provenance: Provenance
) -> str:
    lines = []
    for id, trial in unique_trials(sweeps, provenance).items():
        state = states[id]
        cells = ["–", "–", "–", "–"]
        if state.event == FINISHED:
            result = load_result(workspace.trials, id)
            run, losses = result["run"], result["losses"]
            cells = [f"{result['parameters']:,}", f"{result['train_flops']:.2e}", f"{run['seconds']:.0f} s",
                     f"{losses[-1]:.3f}"]  # fmt: skip
        message = html.escape(state.message)
        status = f'<span class="{state.event}">{state.event}</span>' + (f" {message}" if message else "")
        lines.append([f"<code>{id}</code>", html.escape(trial.title), status, *cells])
    done = sum(states[id].event == FINISHED for id in unique_trials(sweeps, provenance))
    head = ["id", "trial", "status", "parameters", "train FLOPs", "time", "last loss"]
    return f"<p>{done} of {len(lines)} finished.</p>" + _table(head, lines, text=3)


def _origin(
    workspace: Workspace, record: Record, provenance: Provenance, result: dict[str, Any] | None
) -> str:
    machine = result["run"]["machine"] if result else {}
    facts = {
        "command": record.command,
        "data": ", ".join(record.data) or f"embedded suite, scale {record.study.suite.scale:g}, "
        f"seed {record.study.suite.seed}",
        "token store": provenance.store,
        "evaluation manifest": provenance.manifest,
        "tokenizer": provenance.tokenizer,
        "sources": provenance.code,
        "commit": machine.get("commit") or "unknown",
        "processor": f"{machine.get('processor', 'unknown')}, {machine.get('cores', '?')} cores",
        "devices": ", ".join(machine.get("devices", [])) or "unknown",
        "software": ", ".join(f"{k} {v}" for k, v in machine.get("packages", {}).items()),
        "numbers": workspace.results.name,
    }
    items = "".join(
        f"<dt>{html.escape(k)}</dt><dd><code>{html.escape(v)}</code></dd>" for k, v in facts.items()
    )
    config = html.escape(to_json(record.study))
    return f"<dl>{items}</dl><details><summary>Configuration</summary><pre>{config}</pre></details>"


# --- Pieces ----------------------------------------------------------------------------------


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{''.join(parts)}</section>"


def _card(label: str, point: CurvePoint | None, note: str) -> str:
    value = _pm(point) if point else "–"
    return f"<div class=card><small>{html.escape(label)}</small><b>{value}</b><small>{html.escape(note)}</small></div>"


def _table(head: Sequence[str], lines: Iterable[Sequence[str]], text: int = 1) -> str:
    """Cells are HTML already, headings are not. The first `text` columns are words, the rest numbers."""

    def row(tag: str, cells: Sequence[str]) -> str:
        kinds = [" class=text" if i < text else "" for i in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{k}>{c}</{tag}>" for k, c in zip(kinds, cells, strict=True)) + "</tr>"

    heading = row("th", [html.escape(h) for h in head])
    body = "".join(row("td", line) for line in lines)
    return f"<div class=scroll><table><thead>{heading}</thead><tbody>{body}</tbody></table></div>"


def _pm(p: CurvePoint) -> str:
    """Mean ± standard error, with the digits that the error leaves meaningful."""
    if math.isnan(p.sem) or p.sem <= 0:
        return f"{p.mean:.4g}"
    return f"{_number(p.mean, p.sem)} <span class=sem>± {_number(p.sem, p.sem)}</span>"


def _change(points: Sequence[CurvePoint]) -> str:
    """From the first to the last point, and how many standard errors lie between them."""
    first, last = points[0], points[-1]
    error = math.hypot(first.sem, last.sem)
    if not error > 0:  # also nan: a single window
        return f"{first.mean:.3g} → {last.mean:.3g}"
    size = abs(last.mean - first.mean) / error
    return f"{_number(first.mean, error)} → {_number(last.mean, error)} ({size:.1f} standard errors)"


def _number(value: float, error: float) -> str:
    """`value` to two digits of `error`."""
    digits = min(max(1 - math.floor(math.log10(error)), 0), 4)
    return f"{value:.{digits}f}".replace("-", "\u2212")


def _last(points: Sequence[CurvePoint]) -> CurvePoint | None:
    return points[-1] if points else None


def _picture(path: Path, title: str) -> str:
    if not path.exists():
        return ""
    return f'<img class=plot alt="{html.escape(title)}" src="{_data_uri(path.read_bytes())}">'


def _frames(clip: np.ndarray, prompt: int) -> str:
    """One row of frames [T, height, width, 3] as an image; a wider gap follows the prompt."""
    count, height, width, _ = clip.shape
    gap, wide = max(width // 16, 1), max(width // 4, 2)
    starts = [t * (width + gap) + (wide if t >= prompt else 0) for t in range(count)]
    row = np.zeros((height, starts[-1] + width, 4), np.uint8)
    for start, frame in zip(starts, clip, strict=True):
        row[:, start : start + width, :3] = frame
        row[:, start : start + width, 3] = 255
    buffer = io.BytesIO()
    Image.fromarray(row).save(buffer, format="PNG", optimize=True)
    return f'<img alt="" src="{_data_uri(buffer.getvalue())}">'


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
