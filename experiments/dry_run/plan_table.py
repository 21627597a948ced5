"""The table of a dry run: every trial of a study once, with its cost, and the totals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

from experiments.dry_run.cost import TrialPlan, checkpoint_bytes, plan_trials
from experiments.dry_run.done import NOTHING, Done
from experiments.dry_run.preparing_cost import PreparingCost, describe, estimate_preparing
from experiments.running.ledger import FAILED
from experiments.running.provenance import Provenance
from experiments.running.trial import trial_id
from experiments.study import Study
from experiments.sweeps.sweep import CONTROL, Sweep, all_steps, reference_trial
from experiments.terminal.progress import tidy_table
from experiments.terminal.words import counted, duration, in_thousands


@dataclass(frozen=True)
class Devices:
    """The devices on which trials are computed."""

    each: float = 1.0  # devices per trial; below 1: several trials share one
    at_once: int | None = 1  # trials at a time; None: the cluster says


def plan_table(
    study: Study,
    sweeps: Sequence[Sweep],
    devices: Devices = Devices(),
    *,
    given: bool = False,
    trained: bool = True,
    evaluated: bool = True,
    done: Done = NOTHING,
) -> Table:
    """Every trial once, with the axes it belongs to, its size and its cost. `given`: the user has the data, `trained`:
    the tokenizer is trained here, `evaluated`: trials are judged, not only trained; `done` is not counted again."""
    plans = plan_trials(study, sweeps, devices.each, evaluated, done)
    several = len({plan.trial.train.steps for plan in plans.values()}) > 1
    budget = f"{all_steps(sweeps)} x batch {study.train.batch}"
    table = tidy_table(
        f"Study '{study.name}': {counted(len(plans), 'trial')} of {budget}",
        "trial", "sets", "videos", "width", *["steps"] * several, "params", "one robot", "FLOPs", "time",
    )  # fmt: skip
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    before = estimate_preparing(
        study, simulated=not (given or done.suite), trained=trained and not done.tokenizer, tokenised=not done.tokens
    )
    left = [plan for id, plan in plans.items() if id not in done.finished and id not in done.left]
    table.caption = _describe_done(done, len(plans))
    if left:
        table.caption += _caption(study, left, devices, before, evaluated)
    elif before.seconds or before.unknown:  # it is made before trials are looked at
        table.caption += f"About {duration(before.seconds)} to prepare: {describe(before)}."
    seeds = {p.trial.train.seed for p in plans.values()}
    shared = {trial_id(reference_trial(study, seed), done.provenance) for seed in seeds}
    axes, places = _axes(sweeps, done.provenance), _places(sweeps, done.provenance)
    rows: dict[str, tuple[str, ...]] = {}
    for id, plan in plans.items():
        trial = plan.trial
        rows[id] = (
            "reference" if id in shared else axes.get(id, "source"),
            f", seed {trial.train.seed}" if len(seeds) > 1 else "",
            f"{len(trial.datasets)}",
            "all" if trial.max_trajectories is None else _short_count(trial.max_trajectories),
            f"{trial.model.width}",
            *[f"{trial.train.steps:,}"] * several,
        )
    count = Counter(rows.values())  # an axis may vary what no column shows
    for id, plan in plans.items():
        (name, seed, *columns), cost = rows[id], plan.cost
        over = "finished" if id in done.finished else done.left.get(id)
        place = f" {places[id]}" if count[rows[id]] > 1 and id in places else ""
        table.add_row(
            escape(name + place + seed),
            *columns,
            in_thousands(cost.parameters),
            in_thousands(cost.parameters_one_robot),
            "" if over else flops_of(plan.flops).removesuffix("FLOP"),
            over or duration(plan.seconds),
        )
    return table


def _describe_done(done: Done, trials: int) -> str:
    """What is not counted because it exists."""
    existing = {"the suite": done.suite, "the tokenizer": done.tokenizer, "tokens": done.tokens}
    parts = [name for name, exists in existing.items() if exists]
    parts += [f"{len(done.finished)} of {trials} trials"] if done.finished else []
    parts += [f"{counted(sum(done.steps.values()), 'step')} of training"] if done.steps else []
    text = f"Already done, and not counted: {', '.join(parts)}. " if parts else ""
    if done.other:
        text += f"{counted(done.other, 'finished trial')} of other data here: not used. "
    if done.left:
        how = " or ".join(sorted(set(done.left.values())))
        unless = "; --retry-failed runs the failed ones again" if FAILED in done.left.values() else ""
        text += f"{len(done.left)} of {trials} trials {how}: not run again, and not counted{unless}. "
    return text


def _caption(study: Study, plans: Sequence[TrialPlan], devices: Devices, before: PreparingCost, evaluated: bool) -> str:
    """The totals: time, FLOPs, devices, device-hours and checkpoints."""
    from hma_jax.runtime.audit import size_of

    trials, flops, alone = sum(p.seconds for p in plans), sum(p.flops for p in plans), max(p.seconds for p in plans)
    workers = devices.at_once or 1
    spent = max(trials / workers, alone)
    if len(plans) == 1:
        what = "to train" if not evaluated else "for the trial"
    elif devices.at_once is None:
        what = f"for the trials, one after the other; {duration(alone)} if the cluster runs all at the same time"
    else:
        what = f"for the trials, {'one after the other' if workers == 1 else f'{workers} at a time'}"
    if not before.seconds and not before.unknown:
        whole = f"About {duration(spent)} {what}"
    elif before.unknown:
        whole = f"About {duration(spent)} {what}, and the preparation: {describe(before)}"
    else:
        whole = (
            f"About {duration(before.seconds + spent)} in all: {duration(before.seconds)} to prepare "
            f"({describe(before)}) and {duration(spent)} {what}"
        )
    number = devices.each * workers
    each = f", {devices.each:g} for each trial," if workers > 1 else ""
    hours = devices.each * trials / 3600
    held = f"{hours:,.{0 if hours >= 100 else 1}f} device-hours"
    judged = "to train and to evaluate, sampler steps included" if evaluated else "to train"
    several = len(plans) > 1
    shared = " Training that trials share is counted once." if several else ""
    control = " 'Control': trained on shuffled actions." if several else ""
    return (
        f"{whole}. {flops_of(flops)} {judged}, priced for {number:g} device{'s' * (number != 1)}{each} at "
        f"{flops_of(study.flops_per_second)}/s each (flops_per_second); {held} "
        f"with {study.trial_seconds:g} s for each to start, compile, decode and write (trial_seconds). "
        f"Checkpoints: {size_of(sum(map(checkpoint_bytes, plans)))}.{shared} 'One robot': parameters with a single "
        f"embodiment of 2 action dimensions. 'Videos' are per dataset.{control}"
    )


def _axes(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, str]:
    """What each trial is, by id: the control, a variant, or a point of one or several axes."""
    names: dict[str, dict[str, str]] = {}
    for sweep in sweeps:
        for point in sweep.points:
            own = "control" if point.role == CONTROL else sweep.remark(point) or sweep.name
            names.setdefault(trial_id(point.trial, provenance), {}).setdefault(sweep.name, own)
    return {id: " + ".join(dict.fromkeys(own.values())) for id, own in names.items()}


def _places(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, str]:
    """The positions of trials on an axis of numbers, by id."""
    return {
        trial_id(point.trial, provenance): f"{point.x:g}"
        for sweep in sweeps
        if sweep.fittable
        for point in sweep.points
    }


def _short_count(n: int) -> str:
    return f"{n // 1_000_000:,} M" if n >= 1_000_000 and n % 1_000_000 == 0 else f"{n:,}"


def flops_of(value: float) -> str:
    """'48.0 MFLOP', '1.2 TFLOP'."""
    for unit, size in (("E", 1e18), ("P", 1e15), ("T", 1e12), ("G", 1e9)):
        if value >= size:
            return f"{value / size:,.1f} {unit}FLOP"
    return f"{value / 1e6:,.1f} MFLOP"
