"""What a trial is: everything about it that is chosen, and the name that follows from that."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Literal

from experiments.running.provenance import Provenance
from experiments.running.results_version import OF_SOME
from hma_jax.config import EvalConfig, ModelConfig, TrainConfig
from hma_jax.config.base import check_fields, later
from hma_jax.config.json import identity_of, stable_hash, to_dict

if TYPE_CHECKING:
    from data_pipelines.loading.selection import LoaderConfig


@dataclass(frozen=True)
class Trial:
    """Everything about a trial that is chosen; `train.seed` also seeds its data order."""

    datasets: tuple[str, ...]  # in the order of the model's embodiment axis
    max_trajectories: int | None  # per dataset; None: all
    evaluated: tuple[str, ...]  # datasets whose validation windows are used
    model: ModelConfig
    train: TrainConfig
    eval: EvalConfig
    tau: float = 3.0
    rate: float | None = 2.0  # frame rate in Hz; None: native
    weighed: Literal["used", "all"] = "used"  # which windows give the mixture's weights
    shuffle_actions: bool = False  # the control: actions from another episode
    measure_untrained: bool = False  # also evaluate the model before its first step
    capped: tuple[str, ...] = later(())  # datasets to which max_trajectories applies; (): all of them
    # A trained model to which `datasets` are added; only these are then trained. None: a new model.
    source: Trial | None = later(None)

    def __post_init__(self):
        check_fields(self)

    def with_source(self) -> tuple[Trial, ...]:
        """The trials that must have run for this one, and this one."""
        return (*self.source.with_source(), self) if self.source else (self,)

    @property
    def title(self) -> str:
        """One line that distinguishes this trial from the others of its study."""
        cap = "all" if self.max_trajectories is None else f"{self.max_trajectories}"
        if self.capped:
            cap = f"{cap} of {len(self.capped)}, all other"
        control = " · shuffled actions" if self.shuffle_actions else ""
        after = f" · after {len(self.source.datasets)} datasets" if self.source else ""
        return (
            f"{len(self.datasets)} datasets · {cap} trajectories · width {self.model.width} · "
            f"seed {self.train.seed}{after}{control}"
        )


def training_of(trial: Trial) -> dict[str, Any]:
    """What determines a trial's training, except its number of steps; what it is judged on, and how, is not part of
    it."""
    fields = to_dict(trial)
    for name in ("evaluated", "eval", "measure_untrained"):
        del fields[name]
    del fields["train"]["steps"]
    if trial.source:
        fields["source"] = training_of(trial.source) | {"steps": trial.source.train.steps}
    return fields


def trajectories_of(
    trial: Trial, available: Mapping[str, int], result: Mapping[str, Any] | None = None
) -> dict[str, int]:
    """{robot: number of training trajectories from which windows are drawn}, as the trial's `result` counts them.
    Without such a count, the `available` ones up to its cap: a few too many if a subset contains damaged ones."""
    if result and "trajectories" in result:
        return dict(result["trajectories"])
    capped, most = trial.capped or trial.datasets, trial.max_trajectories
    return {
        name: available[name] if most is None or name not in capped else min(available[name], most)
        for name in trial.datasets
        if name in available
    }


@functools.cache
def trial_id(trial: Trial, provenance: Provenance) -> str:
    """The name of a trial: equal exactly when everything that determines it is equal."""
    return stable_hash({"trial": _identity(trial), "provenance": provenance})


def _identity(trial: Trial) -> dict[str, Any]:
    fields = identity_of(trial)
    if trial.source:
        fields["source"] = _identity(trial.source)
    altered = [
        what
        for what, where in OF_SOME.items()
        if all(_has(attrgetter(path)(trial), wanted) for path, wanted in where.items())
    ]
    return fields | {"altered": altered} if altered else fields


def _has(found: Any, wanted: Any) -> bool:
    """Whether a field has the `wanted` value, or one for which the function `wanted` is true."""
    return wanted(found) if callable(wanted) else found == wanted


def loader_of(trial: Trial) -> LoaderConfig:
    """Which windows a trial draws, and in what order."""
    from data_pipelines.loading.selection import LoaderConfig

    return LoaderConfig(
        frames=trial.model.frames,
        batch=trial.train.batch,
        tau=trial.tau,
        seed=trial.train.seed,
        max_trajectories=trial.max_trajectories,
        datasets=trial.datasets,
        shuffle_actions=trial.shuffle_actions,
        rate=trial.rate,
        weighed=trial.weighed,
        capped=trial.capped,
    )
