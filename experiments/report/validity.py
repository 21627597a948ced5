"""The checks, at the top of a study's page, by which a reader can tell whether its numbers can be trusted.

Each is a sentence with a verdict. A check that cannot be decided says why and counts as open, never as passed.
"""

from __future__ import annotations

import html
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from experiments.analysis.compare import lacks_numbers
from experiments.analysis.controllability import ROUNDING
from experiments.analysis.intervals import HELD_OUT_LOSS, standard_errors
from experiments.analysis.optima import Optimum, ends
from experiments.analysis.predictions import Outcome
from experiments.analysis.preregistered import ExpectationOutcome, count_inside
from experiments.analysis.rows import OVERALL, TRAINING_LOSS, UNTRAINED, Row
from experiments.report.pieces import section
from experiments.report.robots import Robot
from experiments.running.attempts import State
from experiments.running.ledger import FINISHED
from experiments.sweeps.sweep import CONTROL, POINT, Sweep
from experiments.terminal.words import counted
from hma_jax.config.json import stable_hash
from hma_jax.evaluation.measures import METRICS, OPTIONAL_METRICS
from hma_jax.evaluation.summary import Summary, summarise
from hma_jax.evaluation.windows import WindowTable

Verdict = Literal["good", "bad", "open"]
MARKS = {"good": "\u2713", "bad": "\u2717", "open": "?"}

SEEDS = 3
"""Per point, at least: below, an error over seeds is a guess."""

EACH, MEAN = 3.0, 2.0
"""Number of standard errors that each control, and their mean, may be from zero."""

CONTROLLED = ("delta_psnr", "action_nats")
"""What has to vanish for a model trained on shuffled actions."""

EXACT = 1e-6
"""Relative difference that recomputing a mean or its error may give: windows are kept in float32."""


@dataclass(frozen=True)
class Check:
    name: str
    verdict: Verdict
    text: str


def draw_box(checks: Sequence[Check]) -> str:
    bad = sum(c.verdict == "bad" for c in checks)
    undecided = sum(c.verdict == "open" for c in checks)
    verdicts = [f"{len(checks) - bad - undecided} of {len(checks)} hold"]
    verdicts += [f"{bad} {'does' if bad == 1 else 'do'} not"] * bool(bad)
    verdicts += [f"{undecided} {'is' if undecided == 1 else 'are'} undecided"] * bool(undecided)
    lines = "".join(
        f"<li class={c.verdict}><span class=mark>{MARKS[c.verdict]}</span><div><b>{html.escape(c.name)}</b> "
        f"{html.escape(c.text)}</div></li>"
        for c in checks
    )
    return section("Can these numbers be believed?", f"<p>{', '.join(verdicts)}.</p><ul class=checks>{lines}</ul>")


def check_study(
    sweeps: Sequence[Sweep],
    rows: Sequence[Row],
    optima: Sequence[Optimum],
    states: Mapping[str, State],
    robots: Sequence[Robot],
    whose: str,
    outcomes: Sequence[Outcome],
    expected: Sequence[ExpectationOutcome],
    numbers: Check,
    vocabulary: int | None,
) -> list[Check]:
    """`robots` are those of the trials called `whose`; `outcomes` are of predictions of fits, `expected` of the
    author's; `numbers` is what `check_numbers` found; `vocabulary` V of a discrete model."""
    checks, measured = [_trials(states), _seeds(sweeps, rows), numbers], {r.metric for r in rows}
    if "psnr" in measured or "action_error" not in measured:  # else no frames were predicted
        checks += _untrained(rows, vocabulary)
        checks += [_controls(rows, metric) for metric in CONTROLLED if metric in measured]
        checks.append(_copying(robots, whose))
    checks += _optima(optima, rows) + [_prediction(o) for o in outcomes] + check_expected(expected)
    return checks


def check_numbers(
    written: Sequence[Row],
    rows: Sequence[Row],
    results: Mapping[str, Mapping[str, Any]],
    windows: Mapping[str, WindowTable],
    group: int,
) -> Check:
    """Whether the tables as they were found (`written`) agree with the results of finished trials (`rows`), and these
    with what follows from their windows. `group` is the evaluation's perplexity_group.

    A trial of which one of the two tables has no row was not written there yet: a report may end between them.
    """
    name = "Every number follows from those of single windows."
    known, drawn = {_key(r): r for r in rows}, {(r.sweep, r.trial) for r in rows}
    written = [r for r in written if r.metric and r.trial in results and (r.sweep, r.trial) in drawn]
    before = {(r.sweep, r.trial, r.of_robot) for r in written}
    edited = [r for r in written if not _same_row(r, known.get(_key(r)))]
    lost = {_key(r) for r in rows if (r.sweep, r.trial, r.of_robot) in before} - {_key(r) for r in written}
    if edited or lost:
        example = _key(edited[0]) if edited else min(lost, key=str)
        where, count = ", ".join(str(part) for part in example if part != ""), len(edited) + len(lost)
        differ = "1 line of the table differs" if count == 1 else f"{count} lines of the table differ"
        return Check(name, "bad", f"{differ} from the trials' results, such as {where}; it was drawn again from them.")
    wrong = [id for id in results if id in windows and not _follows(results[id], windows[id], group)]
    if wrong:
        return Check(name, "bad", f"The results of {len(wrong)} trials do not follow from their windows: {wrong[0]}.")
    if broken := _without_numbers(windows):
        (id, metric), count = next(iter(broken.items()))
        others = f", nor have {counted(len(broken) - 1, 'more')}" if len(broken) > 1 else ""
        text = f"{id} has no {metric} of {counted(count, 'window')}{others}; no difference is taken of these"
        if of_others := list(dict.fromkeys(m for _, m in broken if m in OPTIONAL_METRICS)):
            text += f", and the means of {', '.join(of_others)} are of the other windows"
        return Check(name, "bad", f"{text}.")
    missing = [id for id in results if id not in windows]
    if missing or not results:
        what = f"{len(missing)} of {len(results)} finished trials kept no numbers of their windows."
        return Check(name, "open", what if results else "No trial is finished.")
    count = sum(len(w) for w in windows.values())
    text = f"Table and results of {len(results)} trials were recomputed from {count:,} windows."
    return Check(name, "good", text)


def _without_numbers(windows: Mapping[str, WindowTable]) -> dict[tuple[str, str], int]:
    """{(trial, metric): windows} for which the trial has no number although every sound model has one; trials with the
    same windows are compared."""
    same: dict[tuple[str, ...], dict[str, np.ndarray]] = defaultdict(dict)
    for id, table in windows.items():
        judged = stable_hash([column.tolist() for column in (table.dataset, table.episode, table.start)])
        for metric, values in table.metrics.items():
            same[metric, judged][id] = values
    found = {}
    for (metric, _), by_trial in same.items():
        lacking = lacks_numbers(metric, np.stack([*by_trial.values()])).sum(1)
        found |= {(id, metric): int(n) for id, n in zip(by_trial, lacking, strict=True) if n}
    return found


def _key(row: Row) -> tuple[Any, ...]:
    return row.sweep, row.x, row.series, row.role, row.seed, row.trial, row.scope, row.metric


def _same_row(a: Row, b: Row | None) -> bool:
    return b is not None and all(_same(getattr(a, f), getattr(b, f)) for f in ("mean", "sem", "n", "episodes"))


def _same(a: float, b: float) -> bool:
    return a == b or math.isnan(a) and math.isnan(b)


def _follows(result: Mapping[str, Any], windows: WindowTable, group: int) -> bool:
    """Whether the means of a result, and their errors, are those of the windows."""
    stated, computed = Summary.from_dict(result["evaluation"]).datasets, summarise(windows, group).datasets
    return stated.keys() == computed.keys() and all(
        metric in computed[robot]
        and _close(stat.mean, computed[robot][metric].mean)
        and _close(stat.sem, computed[robot][metric].sem)
        for robot, stats in stated.items()
        for metric, stat in stats.items()
    )


def _close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=EXACT, abs_tol=EXACT) or not (math.isfinite(a) or math.isfinite(b))


def _trials(states: Mapping[str, State]) -> Check:
    without = Counter(state.event for state in states.values() if state.event != FINISHED)
    done = len(states) - without.total()
    rest = "".join(f", {n} {event}" for event, n in sorted(without.items()))
    text = f"{done} of {len(states)} finished{rest}."
    return Check("Every planned trial is finished.", "bad" if without else "good", text)


def _seeds(sweeps: Sequence[Sweep], rows: Sequence[Row]) -> Check:
    """Distinct seeds with a result, at each point of each curve."""
    planned = {(s.name, p.x, p.series, p.role) for s in sweeps for p in s.points if p.role != CONTROL}
    seeds: dict[tuple[Any, ...], set[int]] = {point: set() for point in planned}
    for r in rows:
        if r.metric and (point := (r.sweep, r.x, r.series, r.role)) in seeds:
            seeds[point].add(r.seed)
    counts = [len(s) for s in seeds.values()]
    few = [point for point, s in seeds.items() if len(s) < SEEDS]
    least, most = min(counts, default=0), max(counts, default=0)
    text = f"{least} per point" if least == most else f"{least} to {most} per point"
    if few:
        text += (
            f"; {counted(len(few), 'point')} of {len(seeds)} {'has' if len(few) == 1 else 'have'} fewer than {SEEDS}, so "
            "the standard error leaves out most or all of the scatter of seeds"
        )
    return Check(f"At least {SEEDS} seeds.", "bad" if few else "good", f"{text}.")


def _untrained(rows: Sequence[Row], vocabulary: int | None) -> list[Check]:
    """Before its first step a model has learnt nothing: its loss must be log V per token, up to rounding."""
    if vocabulary is None:
        return []
    name, expected = "An untrained model is at chance.", math.log(vocabulary)
    losses = [r.mean for r in rows if (r.role, r.scope, r.metric) == (UNTRAINED, OVERALL, HELD_OUT_LOSS)]
    if not losses:
        return [Check(name, "open", "No trial was judged before its first step.")]
    off = max(losses, key=lambda v: abs(v - expected))
    text = f"{off:.4f} nats per token before the first step; log {vocabulary:,} is {expected:.4f}."
    return [Check(name, "good" if abs(off - expected) < 1e-3 * expected else "bad", text)]


def _controls(rows: Sequence[Row], metric: str) -> Check:
    """Trials on shuffled actions, each once: their mean has the error of independent ones."""
    label = METRICS[metric].label
    name = f"Trained without true actions, {label} is zero."
    controls: dict[str, Row] = {}
    for r in rows:  # a trial that is on several axes is tested over the most windows
        if (r.role, r.scope, r.metric) == (CONTROL, OVERALL, metric):
            controls[r.trial] = max(controls.get(r.trial, r), r, key=lambda row: row.n)
    if not controls:
        return Check(name, "open", "No control, trained on shuffled actions, is finished.")
    # A rounding residue is no effect, even if its standard error is as small.
    controls = {id: replace(r, mean=0.0, sem=0.0) if abs(r.mean) < ROUNDING else r for id, r in controls.items()}
    unknown = [r.trial for r in controls.values() if math.isfinite(r.mean) and math.isnan(r.sem)]
    known = [r for id, r in controls.items() if id not in unknown]
    far = max((abs(standard_errors(r.mean, r.sem)) for r in known), default=0.0)
    if unknown and far <= EACH:
        text = (
            f"The errors of {len(unknown)} of {len(controls)} controls are unknown: one episode per robot gives none."
        )
        return Check(name, "open", text)
    mean = sum(r.mean for r in known) / len(known)
    sem = math.sqrt(sum(r.sem**2 for r in known)) / len(known)
    fine = far <= EACH and abs(standard_errors(mean, sem)) <= MEAN  # nan: not fine
    off = f"{standard_errors(mean, sem):+.1f}"
    text = f"{len(known)} controls: at most {far:.1f} standard errors from zero, their mean {off}"
    if len(known) == 1:
        text = f"One control: {off} standard errors from zero"
    text = f"{text} (allowed: {EACH:g} each, {MEAN:g} for the mean).".replace("-", "\u2212")
    return Check(name, "good" if fine else "bad", text)


def _copying(robots: Sequence[Robot], whose: str) -> Check:
    """The trials called `whose` against repeating the last frame that was given."""
    name = "Prediction beats copying the last frame."
    judged = [r for r in robots if not math.isnan(r.ahead)]
    if not judged:
        return Check(name, "open", f"The {whose} is not finished.")
    better = [r for r in judged if r.ahead > 0]
    sure = [r for r in judged if r.ahead > 2 * r.ahead_sem]
    behind = ", ".join(r.name for r in judged if not r.ahead > 0)
    text = f"On {len(better)} of {len(judged)} robots the {whose} is ahead, on {len(sure)} by more than two standard errors"
    return Check(name, "bad" if behind else "good", text + (f". Not on {behind}." if behind else "."))


def _optima(optima: Sequence[Optimum], rows: Sequence[Row]) -> list[Check]:
    """Checks of the optimal learning rate of muP's curves, on held-out data where there is a likelihood.

    The best rate of the standard parametrisation is a finding, not a condition. An optimum is inside the grid if on
    both sides a rate is significantly worse. It is open if the seeds cannot distinguish it from an end of the grid:
    more seeds may.
    """
    judged_by = HELD_OUT_LOSS if any(o.metric == HELD_OUT_LOSS for o in optima) else TRAINING_LOSS
    mup = [o for o in optima if (o.role, o.metric) == (POINT, judged_by)]
    if not mup:
        return []
    at_end = [o.series for o in mup if o.x in ends(rows, o.sweep, o.role, o.series)]
    alone = [o.series for o in mup if math.isnan(o.seed_sem) and o.series not in at_end]
    near_end = [o.series for o in mup if o.edge == "edge" and o.series not in at_end]
    unknown = [o.series for o in mup if o.edge == "open" and o.series not in at_end]
    said = {
        "at an end of the grid": at_end, "not told from one at an end": near_end, "told by one seed only": alone,
        "on one side no rate is told to be worse, as one there has one seed or no result,": unknown,
    }  # fmt: skip
    text = "; ".join(f"{what} for {', '.join(series)}" for what, series in said.items() if series)
    text = f"{text[0].upper()}{text[1:]}." if text else f"On all {len(mup)} curves with muP."
    verdict: Verdict = "bad" if at_end else "open" if near_end or alone or unknown else "good"
    return [Check("The best learning rate lies inside the grid.", verdict, text)]


def _prediction(outcome: Outcome) -> Check:
    p = outcome.prediction
    text = f"{p.curve} at {p.position}: predicted {p.mean:.3f} nats ({p.low:.3f} to {p.high:.3f} with {p.level:.0%})"
    if outcome.observed is None:
        verdict: Verdict = "open"
        text += "." if outcome.seeds else "; its trials have not run."
    elif outcome.inside is None:
        verdict = "open"
        text += f"; observed so far {outcome.observed:.3f} ({outcome.seeds} of {counted(len(p.trials), 'trial')})."
    else:
        verdict = "bad" if outcome.marks or not outcome.inside else "good"
        text += f"; observed {outcome.observed:.3f} ({counted(outcome.seeds, 'seed')}), {'inside' if outcome.inside else 'outside'}."
    if outcome.marks:
        verdict, text = "bad", f"{text} But: {'; '.join(outcome.marks)}."
    return Check("A preregistered prediction of a fit holds.", verdict, text)


def check_expected(outcomes: Sequence[ExpectationOutcome]) -> list[Check]:
    """Checks all of the author's intervals together: they have no stated level, so a single miss is one too many."""
    if not outcomes:
        return []
    inside, known = count_inside(outcomes)
    open_ones = len(outcomes) - known
    text = f"{inside} of {known} do" if known else "None has an outcome yet"
    axes: dict[str, list[ExpectationOutcome]] = defaultdict(list)
    for outcome in outcomes:
        if outcome.inside is not None:
            axes[outcome.expected.sweep].append(outcome)
    if len(axes) > 1:
        text += ": " + ", ".join("{} {} of {}".format(axis, *count_inside(own)) for axis, own in axes.items())
    text += "."
    if known and open_ones:
        text += f" {open_ones} more {'has' if open_ones == 1 else 'have'} no outcome yet."
    verdict: Verdict = "bad" if inside < known else "open" if open_ones else "good"
    return [Check("The author's preregistered intervals contain the outcomes.", verdict, text)]
