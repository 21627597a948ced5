"""What a study will cost, before it runs: parameters, FLOPs and a time estimate per trial.

Needs no data and no device: action sizes come from the registry, parameter counts from the declared
model without making an array. The rate of a device and the times are those of the preset's machine
(`Study.flops_per_second`, `Study.trial_seconds`); n devices are assumed to be n times as fast. What trials have in
common is counted once; what is made before the first one is estimated in `preparing_cost`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from experiments.declared_table import declared_table
from experiments.dry_run.done import NOTHING, Done
from experiments.running.run_options import UNWATCHED
from experiments.running.shared_runs import share_runs
from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Sweep, unique_trials
from hma_jax.config import ModelConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable


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

    table, config = _table_of(trial), trial.eval
    windows = len(trial.evaluated) * config.windows_per_dataset
    batches = -(-windows // config.batch)  # the last batch is padded
    if trial.measure_untrained:
        batches += -(-len(trial.evaluated) * min(config.batch, config.windows_per_dataset) // config.batch)
    return Cost(
        parameters=_count_parameters(trial.model, table),
        parameters_one_robot=_count_parameters(trial.model, ONE_ROBOT),
        train_flops=train_flops_per_step(trial.model, table, trial.train) * trial.train.steps,
        evaluation_flops=batches * config.batch * evaluation_flops_per_window(trial, table),
    )


def count_parameters(trial: Trial) -> int:
    """Number of parameters of the trial's model, with one embodiment slice for each of the trial's robots."""
    return _count_parameters(trial.model, _table_of(trial))


def _table_of(trial: Trial) -> EmbodimentTable:
    names = trial.datasets if trial.source is None else (*trial.source.datasets, *trial.datasets)
    return declared_table(names, trial.rate)


@functools.cache
def _count_parameters(model: ModelConfig, table: EmbodimentTable) -> int:
    from hma_jax.model.hma import declare_model

    return declare_model(model, table).count()


def evaluation_flops_per_window(trial: Trial, table: EmbodimentTable) -> float:
    """The protocol on one window: likelihood under the recorded actions and those of other episodes, predicted frames,
    frames under random actions and (counted although users' data have none) under another episode's actions, and the
    policy; of these, the parts that the model is trained for."""
    from hma_jax.evaluation.protocol import predicts_actions, predicts_frames
    from hma_jax.generation.flops import rollout_flops, sampler_flops
    from hma_jax.model.flops import denoiser_flops, pass_flops

    model, config, decode, setting = trial.model, trial.eval, trial.eval.decode, trial.train.masking.setting
    frames, draws, flops = model.frames, config.random_actions, 0.0
    if predicts_actions(model, setting):
        copies = 1 if model.action_alignment == "causal" else 2
        flops += copies * pass_flops(model, table, frames, frames / 2, predicted=0)
        if model.diffusion:
            steps = decode.sampler.steps
            flops += steps * denoiser_flops(model, frames, own_steps=False, channels=table.action_width)
    if not predicts_frames(setting):
        return flops
    window_pass = pass_flops(model, table, frames - 1, frames / 2)  # every frame but one, masked
    true_pass = pass_flops(model, table, frames - 1, frames / 2, predicted=0)  # the frames before these
    likelihood = true_pass + window_pass
    if model.diffusion:
        likelihood += denoiser_flops(model, model.diffusion.repeats * (frames - 1) * model.tokens)
    flops += (1 + config.other_actions) * likelihood
    if config.context == "recorded":
        flops += (true_pass + window_pass) * (config.other_actions > 0)  # the likelihood once more, for decoding
        flops += (decode.unmask_steps - 1) * window_pass + (frames - 1) * sampler_flops(model, decode)
        flops += draws * rollout_flops(model, table, decode, frames, frames - 1)
    else:
        sequences = 1 + draws + (config.other_actions > 0)
        flops += rollout_flops(model, table, decode, frames, config.prompt_frames, sequences=sequences)
    return flops


@dataclass(frozen=True)
class TrialPlan:
    """The remaining cost of one trial, after the trials with which it shares the beginning of its training."""

    trial: Trial
    cost: Cost
    flops: float  # not shared with others
    seconds: float
    keep: tuple[int, ...] = ()  # steps whose checkpoints are kept, for trials that continue from there


def plan_trials(
    study: Study, sweeps: Sequence[Sweep], devices: float = 1.0, evaluated: bool = True, done: Done = NOTHING
) -> dict[str, TrialPlan]:
    """What is left to do for every trial of `sweeps`, by id, each on this number of `devices`. `evaluated`: not only
    trained."""
    trials = unique_trials(sweeps, done.provenance)
    shared = share_runs(trials)
    plans = {}
    for id, trial in trials.items():
        cost = estimate(trial)
        if id in done.finished or id in done.left:
            plans[id] = TrialPlan(trial, cost, 0.0, 0.0, shared[id].keep)
            continue
        all_flops = cost.flops if evaluated else cost.train_flops
        trained_share = max(done.steps.get(id, 0), *(step for _, step in shared[id].before), 0) / trial.train.steps
        flops = all_flops - min(trained_share, 1.0) * cost.train_flops
        seconds = flops / (devices * study.flops_per_second) + study.trial_seconds
        plans[id] = TrialPlan(trial, cost, flops, seconds, shared[id].keep)
    return plans


def checkpoint_bytes(plan: TrialPlan) -> int:
    """Size of the checkpoints that a finished trial leaves."""
    trial, train = plan.trial, plan.trial.train
    every, _ = UNWATCHED.steps_between(train.steps)
    saved = {*(range(every, train.steps, every) if every else ()), *plan.keep, train.steps}
    kept = {*sorted(saved)[-UNWATCHED.keep_checkpoints :], *plan.keep}
    size = _state_bytes(trial.model, _table_of(trial), train.ema_decay > 0, train.only)
    return max(len(kept), UNWATCHED.keep_checkpoints) * size


@functools.cache
def _state_bytes(model: ModelConfig, table: EmbodimentTable, average: bool, only: tuple[str, ...]) -> int:
    import jax

    from hma_jax.model.hma import declare_model
    from hma_jax.training.state import state_shapes

    state = state_shapes(declare_model(model, table), table, average=average, only=only)
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
