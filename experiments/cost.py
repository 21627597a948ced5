"""What a study will cost, before it runs: parameters, FLOPs and a time estimate per trial.

Needs no data and no device: action sizes come from the registry, parameter counts from the declared
model without making an array. The rate of a device and times are those of the preset's machine
(`Study.flops_per_second`, `Study.trial_seconds`); several devices are taken to be as many times faster. What trials
have in common is counted once; what is made before the first one is estimated in `preparing_cost`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from experiments.done import NOTHING, UNKNOWN, Done
from experiments.preparing_cost import PreparingCost, describe, estimate_preparing
from experiments.progress import tidy_table
from experiments.running.provenance import Provenance
from experiments.running.run_options import UNWATCHED
from experiments.running.shared_runs import share_runs
from experiments.running.trial import Trial, trial_id
from experiments.study import Study
from experiments.sweeps.sweep import CONTROL, Sweep, all_steps, reference_trial, unique_trials
from experiments.words import few
from hma_jax.config import MeshConfig, ModelConfig, TrainConfig, require
from hma_jax.model.embodiments import Embodiment, EmbodimentTable

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec

@dataclass(frozen=True)
class Cost:
    parameters: int  # with the trial's own mixture
    parameters_one_robot: int  # with a single embodiment of 2 action dimensions
    train_flops: float
    evaluation_flops: float

    @property
    def flops(self) -> float:
        return self.train_flops + self.evaluation_flops


ONE_ROBOT = EmbodimentTable((Embodiment("one_robot", 2, 1, mean=(0.0, 0.0), std=(1.0, 1.0)),))


def estimate(trial: Trial) -> Cost:
    """The cost of one trial, by formula (`hma_jax.model.flops`, `hma_jax.generation.flops`)."""
    from hma_jax.model.flops import train_flops_per_step

    names = trial.datasets if trial.source is None else (*trial.source.datasets, *trial.datasets)
    table, config = declared_table(names, trial.rate), trial.eval
    windows = len(trial.evaluated) * config.windows_per_dataset
    batches = -(-windows // config.batch)  # the last one is filled up
    if trial.measure_untrained:
        batches += -(-len(trial.evaluated) * min(config.batch, config.windows_per_dataset) // config.batch)
    return Cost(
        parameters=_count_parameters(trial.model, table),
        parameters_one_robot=_count_parameters(trial.model, ONE_ROBOT),
        train_flops=train_flops_per_step(trial.model, table, trial.train) * trial.train.steps,
        evaluation_flops=batches * config.batch * evaluation_flops_per_window(trial, table),
    )


@functools.cache
def _count_parameters(model: ModelConfig, table: EmbodimentTable) -> int:
    from hma_jax.model.hma import declare_model

    return declare_model(model, table).count()


def declared_table(names: Sequence[str], rate: float | None = 2.0) -> EmbodimentTable:
    """Embodiments with the right action sizes and no statistics.

    Raises ConfigError for a name that the registry does not know.
    """
    return _declare(tuple(names), rate)


@functools.cache
def _declare(names: tuple[str, ...], rate: float | None) -> EmbodimentTable:
    from data_pipelines.registry import get_spec

    def entry(spec: DatasetSpec) -> Embodiment:
        dim = spec.action_dim
        return Embodiment(spec.name, dim, spec.stride_at(rate), mean=(0.0,) * dim, std=(1.0,) * dim)

    return EmbodimentTable(tuple(entry(get_spec(name)) for name in names))


def evaluation_flops_per_window(trial: Trial, table: EmbodimentTable) -> float:
    """The protocol on one window: likelihood under the recorded actions and other episodes', predicted frames, those under
    random actions and (counted though users' data have none) under another episode's, and the policy."""
    from hma_jax.evaluation.protocol import predicts_actions
    from hma_jax.generation.flops import rollout_flops, sampler_flops
    from hma_jax.model.flops import denoiser_flops, pass_flops

    model, config, decode = trial.model, trial.eval, trial.eval.decode
    frames, draws = model.frames, config.random_actions
    beside = pass_flops(model, table, frames - 1, frames / 2)  # every frame but one, true or masked
    likelihood = 2 * beside
    if model.diffusion:
        likelihood += denoiser_flops(model, model.diffusion.repeats * (frames - 1) * model.tokens)
    flops = (1 + config.other_actions) * likelihood
    if config.context == "recorded":
        flops += 2 * beside * (config.other_actions > 0)  # the likelihood once more, for decoding
        flops += (decode.unmask_steps - 1) * beside + (frames - 1) * sampler_flops(model, decode)
        flops += draws * rollout_flops(model, table, decode, frames, frames - 1)
    else:
        sequences = 1 + draws + (config.other_actions > 0)
        flops += rollout_flops(model, table, decode, frames, config.prompt_frames, sequences=sequences)
    if predicts_actions(model, trial.train.masking.setting):
        copies = 1 if model.action_alignment == "causal" else 2
        flops += copies * pass_flops(model, table, frames, frames / 2)
    return flops


@dataclass(frozen=True)
class TrialPlan:
    """What one trial of a study will take, after those that it shares the beginning of its training with."""

    trial: Trial
    cost: Cost
    flops: float  # that it has to itself
    seconds: float


@dataclass(frozen=True)
class Devices:
    """What trials are computed on."""

    each: float = 1.0  # of a trial; below 1: several trials share one
    at_once: int | None = 1  # trials at a time; None: the cluster says


def devices_of(mesh: MeshConfig, share: float | None) -> float:
    """The devices that a program uses of its `share`; where nobody says that, as many as the mesh takes at least.

    Raises ConfigError for a mesh that does not fit them, as training would.
    """
    from hma_jax.runtime.mesh import mesh_sizes

    share = share or float(mesh.least)
    mesh_sizes(mesh, math.ceil(share))
    return share


def check_trials(study: Study, sweeps: Sequence[Sweep], share: float | None) -> float:
    """`devices_of` each trial. Raises ConfigError also for one whose batch or model does not divide over them, whose
    learning rate would not do what is said of it, or that is to train robots alone that it does not have."""
    from hma_jax.runtime.mesh import check_sizes, mesh_sizes
    from hma_jax.training.optimizer import check_schedule

    execution = study.execution
    devices = devices_of(execution.mesh, share)
    sizes = mesh_sizes(execution.mesh, math.ceil(devices))
    for trial in unique_trials(sweeps, UNKNOWN).values():
        check_sizes(sizes, trial.model, trial.train.batch, execution.accumulate)
        check_schedule(trial.train.optimizer, trial.train.steps)
        require_only(trial.train, [name for one in trial.with_source() for name in one.datasets])
    return devices


def require_only(train: TrainConfig, robots: Sequence[str]) -> None:
    """Raises ConfigError where `train.only` names others than the `robots` that a model is trained on."""
    without = [name for name in train.only if name not in robots]
    require(not without, f"train.only: there is no robot {few(without)} to train, but {few(robots)}")


def plan_trials(
    study: Study, sweeps: Sequence[Sweep], devices: float = 1.0, evaluated: bool = True, done: Done = NOTHING
) -> dict[str, TrialPlan]:
    """Every trial of `sweeps` by id, each on so many `devices`: what is left of it. `evaluated`: not only trained."""
    trials = unique_trials(sweeps, done.provenance)
    shared = share_runs(trials)
    plans = {}
    for id, trial in trials.items():
        cost = estimate(trial)
        if id in done.finished:
            plans[id] = TrialPlan(trial, cost, 0.0, 0.0)
            continue
        whole = cost.flops if evaluated else cost.train_flops
        begun = max(done.steps.get(id, 0), *(step for _, step in shared[id].before), 0) / trial.train.steps
        flops = whole - min(begun, 1.0) * cost.train_flops
        plans[id] = TrialPlan(trial, cost, flops, flops / (devices * study.flops_per_second) + study.trial_seconds)
    return plans


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
    budget = f"{all_steps(sweeps)} steps x batch {study.train.batch}"
    table = tidy_table(
        f"Study '{study.name}': {len(plans)} trial{'s' * (len(plans) != 1)} of {budget}",
        "trial", "sets", "videos", "width", *["steps"] * several, "params", "one robot", "FLOPs", "time",
    )  # fmt: skip
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    before = estimate_preparing(
        study, simulated=not (given or done.suite), trained=trained and not done.tokenizer, tokenised=not done.tokens
    )
    left = [plan for id, plan in plans.items() if id not in done.finished]
    table.caption = _say_done(done, len(plans))
    if left:
        table.caption += _caption(study, left, devices, before, evaluated)
    elif before.seconds or before.unknown:  # it is made before trials are looked at
        table.caption += f"About {_duration(before.seconds)} to prepare: {describe(before, _duration)}."
    seeds = {p.trial.train.seed for p in plans.values()}
    shared = {trial_id(reference_trial(study, seed), done.provenance) for seed in seeds}
    axes = _axes(sweeps, done.provenance)
    for id, plan in plans.items():
        trial, cost, over = plan.trial, plan.cost, id in done.finished
        seed = f", seed {trial.train.seed}" if len(seeds) > 1 else ""
        table.add_row(
            escape(("reference" if id in shared else axes.get(id, "source")) + seed),
            f"{len(trial.datasets)}",
            "all" if trial.max_trajectories is None else _short_count(trial.max_trajectories),
            f"{trial.model.width}",
            *[f"{trial.train.steps:,}"] * several,
            _count(cost.parameters),
            _count(cost.parameters_one_robot),
            "" if over else _flops(plan.flops).removesuffix("FLOP"),
            "finished" if over else _duration(plan.seconds),
        )
    return table


def _say_done(done: Done, trials: int) -> str:
    """What is not counted, since it is there."""
    before = {"the suite": done.suite, "the tokenizer": done.tokenizer, "tokens": done.tokens}
    parts = [name for name, there in before.items() if there]
    parts += [f"{len(done.finished)} of {trials} trials"] if done.finished else []
    parts += [f"{sum(done.steps.values()):,} steps of unfinished training"] if done.steps else []
    return f"There already, and not counted: {', '.join(parts)}. " if parts else ""


def _caption(
    study: Study, plans: Sequence[TrialPlan], devices: Devices, before: PreparingCost, evaluated: bool
) -> str:
    """What it all comes to, and of what."""
    from hma_jax.runtime.audit import size_of

    trials, flops, alone = sum(p.seconds for p in plans), sum(p.flops for p in plans), max(p.seconds for p in plans)
    workers = devices.at_once or 1
    spent = max(trials / workers, alone)
    if len(plans) == 1:
        what = "to train" if not evaluated else "for the trial"
    elif devices.at_once is None:
        what = f"for the trials, one after the other; {_duration(alone)} if the cluster runs all at a time"
    else:
        what = f"for the trials, {'one after the other' if workers == 1 else f'{workers} at a time'}"
    if not before.seconds and not before.unknown:
        whole = f"About {_duration(spent)} {what}"
    elif before.unknown:
        whole = f"About {_duration(spent)} {what}, and what it takes to prepare: {describe(before, _duration)}"
    else:
        whole = (
            f"About {_duration(before.seconds + spent)} in all: {_duration(before.seconds)} to prepare "
            f"({describe(before, _duration)}) and {_duration(spent)} {what}"
        )
    number = devices.each * workers
    each = f", {devices.each:g} for each trial," if workers > 1 else ""
    hours = devices.each * trials / 3600
    held = f"{hours:,.{0 if hours >= 100 else 1}f} device-hours"
    judged = "to train and to evaluate, sampler steps included" if evaluated else "to train"
    shared = "" if len(plans) == 1 else " What trials have in common is counted once."
    return (
        f"{whole}. {_flops(flops)} {judged}, priced for {number:g} device{'s' * (number != 1)}{each} at "
        f"{_flops(study.flops_per_second)}/s each (flops_per_second); {held} "
        f"with {study.trial_seconds:g} s for each to start, compile, decode and write (trial_seconds). "
        f"Checkpoints: {size_of(sum(map(checkpoint_bytes, plans)))}.{shared} 'One robot': parameters with a single "
        "embodiment of 2 action dimensions. 'Videos' are per dataset. 'Control': trained on shuffled actions."
    )


def checkpoint_bytes(plan: TrialPlan) -> int:
    """Size of the checkpoints that a finished trial leaves: weights and two moments in float32, and the weights' average
    where there is one."""
    copies = 3 + (plan.trial.train.ema_decay > 0)
    return UNWATCHED.keep_checkpoints * copies * 4 * plan.cost.parameters


def _axes(sweeps: Sequence[Sweep], provenance: Provenance) -> dict[str, str]:
    """What every trial is, by id: the control, a variant, or a point of one axis or several."""
    names: dict[str, dict[str, str]] = {}
    for sweep in sweeps:
        for point in sweep.points:
            own = "control" if point.role == CONTROL else sweep.remark(point) or sweep.name
            names.setdefault(trial_id(point.trial, provenance), {}).setdefault(sweep.name, own)
    return {id: " + ".join(dict.fromkeys(own.values())) for id, own in names.items()}


def _count(parameters: int) -> str:
    return f"{parameters / 1e6:,.1f} M" if parameters >= 1e6 else f"{parameters / 1e3:,.1f} k"


def _short_count(n: int) -> str:
    return f"{n // 1_000_000:,} M" if n >= 1_000_000 and n % 1_000_000 == 0 else f"{n:,}"


def _flops(value: float) -> str:
    for unit, size in (("E", 1e18), ("P", 1e15), ("T", 1e12), ("G", 1e9)):
        if value >= size:
            return f"{value / size:,.1f} {unit}FLOP"
    return f"{value / 1e6:,.1f} MFLOP"


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds:.0f} s"
