"""What a study will cost, before it runs: parameters, FLOPs and a time estimate per trial.

Needs no data and no device: action sizes come from the registry, parameter counts from the declared
model without making an array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.table import Table

from experiments.progress import tidy_table
from experiments.provenance import Provenance
from experiments.study import Study
from experiments.sweep import CONTROL, Sweep, all_steps, reference_trial, unique_trials
from experiments.trial import Trial, trial_id
from hma_jax.model.embodiments import Embodiment, EmbodimentTable

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec

UNKNOWN = Provenance("", "", "", "")
"""Stands in where only the trials' own fields matter."""


@dataclass(frozen=True)
class Cost:
    parameters: int  # with the trial's own mixture
    parameters_one_robot: int  # with a single embodiment of 2 action dimensions
    train_flops: float
    evaluation_flops: float

    @property
    def flops(self) -> float:
        return self.train_flops + self.evaluation_flops


def declared_table(names: Sequence[str]) -> EmbodimentTable:
    """Embodiments with the right action sizes and no statistics.

    Raises ConfigError for a name that the registry does not know.
    """
    from data_pipelines.registry import get_spec

    def entry(spec: DatasetSpec) -> Embodiment:
        dim = spec.action_dim
        return Embodiment(spec.name, dim, spec.stride, mean=(0.0,) * dim, std=(1.0,) * dim)

    return EmbodimentTable(tuple(entry(get_spec(name)) for name in names))


ONE_ROBOT = EmbodimentTable((Embodiment("one_robot", 2, 1, mean=(0.0, 0.0), std=(1.0, 1.0)),))


def estimate(trial: Trial) -> Cost:
    """The cost of one trial, by formula (`hma_jax.model.flops`).

    Evaluation of a window: one pass for the likelihood and, with the temporal cache, about
    `unmask_steps` passes for each of the 1 + random_actions rollouts.
    """
    from hma_jax.model.flops import forward_flops_per_window, train_flops_per_window
    from hma_jax.model.hma import declare_model

    table = declared_table(trial.datasets)
    forward = forward_flops_per_window(trial.model, table)
    rollouts = (1 + trial.eval.random_actions) * trial.eval.decode.unmask_steps
    windows = len(trial.evaluated) * trial.eval.windows_per_dataset
    return Cost(
        parameters=declare_model(trial.model, table).count(),
        parameters_one_robot=declare_model(trial.model, ONE_ROBOT).count(),
        train_flops=train_flops_per_window(trial.model, table) * trial.train.batch * trial.train.steps,
        evaluation_flops=forward * windows * (1 + rollouts),
    )


def plan_table(study: Study, sweeps: Sequence[Sweep]) -> Table:
    """Every trial once, with the axes it belongs to, its size and its cost."""
    trials = unique_trials(sweeps, UNKNOWN)
    costs = {id: estimate(trial) for id, trial in trials.items()}
    total = sum(c.flops for c in costs.values())
    budget = f"{all_steps(sweeps)} steps x batch {study.train.batch}"
    table = tidy_table(
        f"Study '{study.name}': {len(trials)} trials of {budget}",
        "trial", "sets", "videos", "width", "params", "one robot", "FLOPs", "time",
    )  # fmt: skip
    table.caption = (
        f"Total {_flops(total)} for training and evaluation, about "
        f"{_duration(total / study.flops_per_second)} of computing at {_flops(study.flops_per_second)}/s "
        "sustained (flops_per_second; compilation and data not counted). 'One robot': parameters with a "
        "single embodiment of 2 action dimensions. 'Videos' are per dataset. 'Control': trained on shuffled "
        "actions."
    )
    seeds = {trial.train.seed for trial in trials.values()}
    shared = {trial_id(reference_trial(study, seed), UNKNOWN) for seed in seeds}
    for id, trial in trials.items():
        cost = costs[id]
        seed = f", seed {trial.train.seed}" if len(seeds) > 1 else ""
        table.add_row(
            ("reference" if id in shared else _axes_of(id, sweeps)) + seed,
            f"{len(trial.datasets)}",
            "all" if trial.max_trajectories is None else _short_count(trial.max_trajectories),
            f"{trial.model.width}",
            _count(cost.parameters),
            _count(cost.parameters_one_robot),
            _flops(cost.flops).removesuffix("FLOP"),
            _duration(cost.flops / study.flops_per_second),
        )
    return table


def _axes_of(id: str, sweeps: Sequence[Sweep]) -> str:
    """What a trial is: the control, a variant, or a point of one axis or several."""
    names: dict[str, str] = {}
    for sweep in sweeps:
        for point in sweep.points:
            if trial_id(point.trial, UNKNOWN) == id:
                own = "control" if point.role == CONTROL else sweep.remark(point) or sweep.name
                names.setdefault(sweep.name, own)
    return " + ".join(dict.fromkeys(names.values()))


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
