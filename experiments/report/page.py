"""The report: one HTML page with the curves, frames, tables and everything needed to repeat it.

Self-contained: images are embedded, nothing is fetched. Numbers come from the rows of the CSV; only frames and run
records are read from the trials' directories.
"""

from __future__ import annotations

import html
import json
import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from experiments.analysis.preregistered import FILE as PREREGISTERED
from experiments.analysis.preregistered import ExpectationOutcome, compare_expected, read_expected
from experiments.analysis.rows import UNTRAINED, CurvePoint, Row, curve, training_loss
from experiments.data_size import count_usable
from experiments.preparing.tokenizer import QUALITY
from experiments.report.clips import describe_clips
from experiments.report.findings import Findings, describe_expected, read_findings
from experiments.report.fits import describe_fits
from experiments.report.mixture import describe_data_along, describe_mixture
from experiments.report.numbers import Numbers
from experiments.report.pieces import card, contents, picture, section, table
from experiments.report.plot_style import OVER, drawn_metrics
from experiments.report.robots import Robot, are_sorted, describe_robots, robots_of
from experiments.report.style import CSS
from experiments.report.sweeps import TWO_PERPLEXITIES, AxisStatistics, describe
from experiments.report.validity import EACH, Check, check_study, draw_box
from experiments.running.attempts import State
from experiments.running.ledger import FINISHED, name_within
from experiments.running.provenance import Provenance
from experiments.running.result_file import SAMPLES
from experiments.running.trial import Trial, trial_id
from experiments.running.trial_checks import describe as describe_sources
from experiments.running.trial_checks import group_by_sources
from experiments.running.workspace import Record, Workspace
from experiments.study import Study
from experiments.sweeps.sweep import CONTROL, POINT, Sweep, all_steps, reference_trial, titles
from experiments.terminal.words import counted
from hma_jax.config import ConfigError
from hma_jax.config.json import to_json
from hma_jax.runtime.files import write_file

REFERENCE = "reference"

ONCE = {"--replace": True, "--accept-code": False, "--retry-failed": False}
"""Flags that hold for one command, and whether a value follows: they are left out of the command that repeats a
study."""


def write_report(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    along: AxisStatistics,
    states: dict[str, State],
    numbers: Numbers,
    checked: Check,
) -> None:
    """Writes workspace.report from `rows`, `numbers` and the figures already drawn; `checked` is what `check_numbers`
    returned."""
    shown, provenance = _choose_shown(sweeps, record.study), record.provenance
    first = trial_id(_defaults(shown.sweep)[0], provenance) if shown else ""
    finished = [id for id, state in states.items() if state.event == FINISHED]
    has_reference = first in finished
    robots = robots_of(rows, shown.sweep, provenance, numbers.windows) if has_reference else []
    name, aside = (shown.name, shown.aside) if shown else (REFERENCE, "")
    model = record.study.model
    vocabulary = None if model.diffusion else model.vocab_size
    expected = compare_expected(read_expected(workspace.predictions / PREREGISTERED), rows)
    checks = check_study(
        sweeps, rows, along.optima, states, robots, name, numbers.outcomes, expected, checked, vocabulary
    )
    usable = count_usable(workspace.data_summary)
    data = {s.name: describe_data_along(s, provenance, numbers.results, usable) for s in sweeps}
    mixture = describe_mixture(_defaults(shown.sweep)[0], numbers.results[first]) if has_reference else ""
    findings = read_findings(workspace.findings, [s.name for s in sweeps])
    headline = _headline(workspace, record, sweeps, rows, states, shown, _finished_when(numbers.results, finished))
    body = [
        draw_box(checks),
        *_curves(workspace, sweeps, rows, along, data, expected, findings),
        _fits(workspace, numbers),
        findings.rest,
        _clips(workspace.trials / first / SAMPLES, record, robots, aside) if has_reference else "",
        section(f"Robots{', the most controllable first' * are_sorted(robots)}{aside}", describe_robots(
            rows, shown.sweep, robots, workspace.data_summary
        )) if has_reference else "",
        section(f"Mixture{aside}", mixture) if mixture else "",
        section("Trials", _trial_table(workspace, sweeps, states, provenance, numbers.results)),
        section("How to repeat it", _origin(workspace, record, finished, numbers.results)),
    ]  # fmt: skip
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>HMA-JAX study: {html.escape(_name(workspace, record.study))}</title><style>{CSS}</style></head>\n"
        f"<body><main>{headline}{contents(''.join(body))}{''.join(body)}</main></body></html>\n"
    )
    write_file(workspace.report, page)


# --- Parts -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ShownTrials:
    """The trials, one a seed, whose numbers, clips and robots the page shows: those at the default of a sweep."""

    sweep: Sweep
    name: str  # what the trials are

    @property
    def aside(self) -> str:
        """What a heading adds if they are not the trials that a reader would expect."""
        return "" if self.name == REFERENCE else f" ({self.name})"


def _choose_shown(sweeps: Sequence[Sweep], study: Study) -> _ShownTrials | None:
    """The reference trials, in the sweep of the widest scope that has them at its default; if none has, the trials at
    the default of the widest sweep that has one."""
    with_default = [s for s in sweeps if _defaults(s)]
    with_reference = [s for s in with_default if all(t == reference_trial(study, t.train.seed) for t in _defaults(s))]
    sweep = max(with_reference or with_default, key=lambda s: len(s.scope), default=None)
    return sweep and _ShownTrials(sweep, REFERENCE if with_reference else f"default of {sweep.name}")


def _defaults(sweep: Sweep) -> list[Trial]:
    return [p.trial for p in sweep.points if p.role == POINT and p.x == sweep.reference_x]


def _headline(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    states: dict[str, State],
    shown: _ShownTrials | None,
    when: str,
) -> str:
    study = record.study
    metrics = drawn_metrics(rows, [s.name for s in sweeps])
    cards = []
    card_notes = {
        "perplexity": ("perplexity", f"vocabulary size is {study.model.vocab_size:,}"),
        "diffusion_loss": ("diffusion loss", "before the first step"),
        "action_error": ("error of actions", "in variances of actions, before the first step"),
    }
    for metric in (m for m in metrics if shown and m in card_notes):
        name, of_untrained = card_notes[metric]
        point = _at_default(rows, shown.sweep, metric)
        several = point and len(point.seeds) > 1
        over = f"s.e. over {OVER[shown.sweep.robots_vary] if several else 'episodes of one seed'}"
        cards.append(card(f"{name}, {shown.name}", point, over))
        untrained = _at_default(rows, shown.sweep, metric, UNTRAINED)
        if untrained or shown.name == REFERENCE:  # of other trials it is not expected
            cards.append(card(f"{name}, untrained", untrained, of_untrained))
    if shown and "delta_psnr" in metrics:
        cards += [
            card(f"ΔPSNR, {shown.name}", _at_default(rows, shown.sweep, "delta_psnr"),
                 "dB, last frame: true minus random actions"),
            card("ΔPSNR, shuffled actions", _at_default(rows, shown.sweep, "delta_psnr", CONTROL),
                 f"dB; a control: should be zero within {EACH:g} standard errors"),
        ]  # fmt: skip
    if quality := _tokenizer_quality(workspace):
        cards.append(card("tokenizer PSNR", quality, "dB, reconstruction of held-out frames"))
    unfinished = sum(state.event != FINISHED for state in states.values())
    lacking = f"{counted(unfinished, 'trial')} {'has' if unfinished == 1 else 'have'} no result"
    warning = f'<p class="warning">{lacking}; see the table of trials.</p>'
    *others, final = [s.gain or s.axis for s in sweeps]
    gains = f"{', '.join(others)} and {final}" if others else final
    return (
        f"<header><h1>HMA study <em>{html.escape(_name(workspace, study))}</em></h1>"
        f"<p class=lead>What an action-conditioned video model over many robots gains from {html.escape(gains)}: "
        f"{counted(max(len(p.trial.datasets) for s in sweeps for p in s.points), 'dataset')}, "
        f"{all_steps(sweeps)} of {counted(study.train.batch, 'window')} per trial.</p>"
        f"<p class=meta>{html.escape(when)}</p></header>"
        f"<div class=cards>{''.join(cards)}</div>{warning if unfinished else ''}"
    )


def _name(workspace: Workspace, study: Study) -> str:
    """The study's name: its preset's, with the directory's added if studies of one preset would otherwise share a
    name."""
    directory = workspace.root.absolute().name
    return study.name if directory == study.name else f"{study.name} ({directory})"


def _finished_when(results: Mapping[str, Mapping[str, Any]], finished: Sequence[str]) -> str:
    """The first and the last day on which a trial finished, by the clocks of the machines that ran them."""
    if not finished:
        return "no trial finished"
    times = [datetime.strptime(results[id]["run"]["finished"], "%Y-%m-%d %H:%M:%S %z") for id in finished]
    first, last = (f"{time:%Y-%m-%d}" for time in (min(times), max(times)))
    return f"trials finished {first}" + f" to {last}" * (first != last)


def _at_default(rows: Sequence[Row], sweep: Sweep, metric: str, role: str = POINT) -> CurvePoint | None:
    points = curve(rows, sweep.name, metric, role, robots_vary=sweep.robots_vary)
    return next((p for p in points if p.x == sweep.reference_x), None)


def _curves(
    workspace: Workspace,
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    along: AxisStatistics,
    data: Mapping[str, str],
    expected: Sequence[ExpectationOutcome],
    findings: Findings,
) -> list[str]:
    """A section for the scaling curves, which share a figure, and one for each other sweep: numbers, what `data` says
    about the data it was trained on, preregistered expectations and the author's findings."""

    def say(sweep: Sweep) -> str:
        said = findings.of_axes.get(sweep.name, "")
        return describe(sweep, rows, along) + data[sweep.name] + describe_expected(sweep, expected) + said

    note = TWO_PERPLEXITIES if "perplexity" in {r.metric for r in rows} else ""
    sections = []
    scaling = [s for s in sweeps if s.single_curve]
    if scaling:
        overview = picture(
            workspace.figures / "scaling.png", "Scaling curves, of which the tables below have the numbers"
        )
        sections.append(section("Scaling curves", overview, note, *(say(s) for s in scaling)))
    for sweep in sweeps:
        if not sweep.single_curve:
            title = sweep.title or sweep.axis.capitalize()
            figure = picture(
                workspace.figures / f"{sweep.name}.png", f"{title}: the numbers of the tables below, over {sweep.axis}"
            )
            sections.append(section(title, figure, "" if sections else note, say(sweep)))
    return sections


def _tokenizer_quality(workspace: Workspace) -> CurvePoint | None:
    path = workspace.tokenizer / QUALITY
    try:
        quality = json.loads(path.read_text())
        return CurvePoint(0, float(quality["mean"]), float(quality["sem"]), math.nan, {}, ())
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: no quality of a tokenizer can be read ({error}); restore the file, or remove it: the page then "
            "does not show it"
        ) from error


def _fits(workspace: Workspace, numbers: Numbers) -> str:
    """The section on fits; '' if no trial has the loss that is fitted, as for policies and latents, which fits.csv then
    states."""
    if not any(fitted.fit.trials for fitted in numbers.fits) and not numbers.outcomes:
        return ""
    figures = {
        "fits.png": "Scaling fits with residuals: the table of fits has their coefficients",
        "isoflop.png": "Loss over size for each budget: the table of budgets has the best sizes",
    }
    drawn = "".join(picture(workspace.figures / name, title) for name, title in figures.items())
    return section("Fits", describe_fits(numbers.fits, numbers.isoflop, numbers.outcomes, drawn))


def _clips(path: Path, record: Record, robots: Sequence[Robot], aside: str) -> str:
    """The clips of one trial, the most controllable robots first; empty without samples."""
    if not path.exists():
        return ""
    order = [robot.name for robot in robots]
    return section(f"What it predicts{aside}", describe_clips(path, record.study.eval.prompt_frames, order))


def _trial_table(
    workspace: Workspace,
    sweeps: Sequence[Sweep],
    states: dict[str, State],
    provenance: Provenance,
    results: Mapping[str, Mapping[str, Any]],
) -> str:
    """Trials without a result, and the finished ones folded: there may be hundreds."""
    finished, others = [], []
    for id, name in titles(sweeps, provenance).items():
        trial, state = [f"<code>{id}</code>", html.escape(name)], states[id]
        if state.event == FINISHED:
            result = results[id]
            run, loss = result["run"], training_loss(result)
            finished.append([
                *trial, f"{result['parameters']:,}", f"{result['train_flops']:.2e}", f"{run['seconds']:.0f} s",
                f"{loss.mean:.3f}",
            ])  # fmt: skip
        else:
            message = html.escape(name_within(workspace.root, state.message))
            status = f'<span class="{state.event}">{state.event}</span>' + (f" {message}" if message else "")
            others.append([*trial, status])
    said = f"<p>{len(finished)} of {len(finished) + len(others)} finished.</p>"
    if others:
        said += table(["id", "trial", "status"], others, text=3)
    if finished:
        head = ["id", "trial", "parameters", "train FLOPs", "time, last attempt", "training loss"]
        said += f"<details><summary>Finished trials</summary>{table(head, finished, text=2)}</details>"
    return said


def _origin(
    workspace: Workspace, record: Record, finished: Sequence[str], results: Mapping[str, Mapping[str, Any]]
) -> str:
    suite, provenance = record.study.suite, record.provenance
    machines = [results[id]["run"]["machine"] for id in finished]
    ran = group_by_sources(workspace.trials, finished)
    several = f"{len(ran)} different ones, by hash: " if len(ran) > 1 else ""
    facts = {
        "command": _repeatable(record.command),
        "data": ", ".join(record.data)
        or f"embedded suite, scale {suite.scale:g}, from {suite.fewest} episodes, seed {suite.seed}",
        "token store": provenance.store,
        "evaluation manifest": provenance.manifest,
        "tokenizer": provenance.tokenizer,
        "version of the results": str(provenance.results),
        "sources": several + "; ".join(describe_sources(ran)) if ran else "unknown",
        "commit": _each([m.get("commit") or "unknown" for m in machines]),
        "processor": _each([_processor(m) for m in machines]),
        "devices": _each([", ".join(m.get("devices", [])) or "unknown" for m in machines]),
        "software": _each([", ".join(f"{k} {v}" for k, v in m.get("packages", {}).items()) for m in machines]),
        "numbers": workspace.results.name,
    }
    items = "".join(f"<dt>{html.escape(k)}</dt><dd><code>{html.escape(v)}</code></dd>" for k, v in facts.items())
    config = html.escape(to_json(record.study))
    return f"<dl>{items}</dl><details><summary>Configuration</summary><pre>{config}</pre></details>"


def _processor(machine: Mapping[str, Any]) -> str:
    """What one trial ran on: if several ran at a time, its slot had a part of the machine's cores."""
    name, cores = machine.get("processor", "unknown"), machine.get("cores")
    return f"{name}, {counted(cores, 'core') if cores else '? cores'} per trial"


def _repeatable(command: str) -> str:
    """A command without the options meant for one run only; some committed studies recorded them."""
    kept, words = [], iter(shlex.split(command))
    for word in words:
        flag, _, value = word.partition("=")
        takes_value = ONCE.get(flag)
        if takes_value is None:
            kept.append(word)
        elif takes_value and not value:
            next(words, None)
    return shlex.join(kept)


def _each(values: Sequence[str]) -> str:
    """What trials ran on: one value if it is the same for all, otherwise each value with its number of trials."""
    counts = Counter(values).most_common()
    if len(counts) == 1:
        return counts[0][0]
    return "; ".join(f"{counted(n, 'trial')}: {what}" for what, n in counts) or "unknown"
