"""The initial model of a training run that continues from a trained model: its parameters, and slices for new
robots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from experiments.running.run_trial import PreparedData
from experiments.running.trial import Trial, loader_of
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from hma_jax.model.embodiments import EmbodimentTable
    from hma_jax.model.params import Params
    from hma_jax.training.runs import Run


class InitialModel(TypedDict):
    """The arguments of `train_trial` for a model that starts from trained parameters."""

    table: EmbodimentTable
    initial: Params
    origin: dict[str, Any]


def add_robots(trained: Run, trial: Trial, prepared: PreparedData) -> InitialModel:
    """`trained` with slices for those of the trial's datasets that it does not know, drawn from the trial's seed."""
    from data_pipelines.loading.selection import training_embodiment
    from hma_jax.training.adapt import add_embodiments

    loader, scale = loader_of(trial), trial.train.action_scale
    new = [name for name in trial.datasets if name not in trained.table.names]
    robots = [training_embodiment(prepared.store, name, loader, scale) for name in new]
    params, table = add_embodiments(trained.params, trained.model, trained.table, robots, trial.train.seed)
    return InitialModel(table=table, initial=params, origin={"step": trained.step, "provenance": trained.provenance})


def initial_from_trial(trial: Trial, source: Path, prepared: PreparedData) -> InitialModel:
    """The initial model of a trial with a source, whose training run is in `source`. Raises ConfigError without its
    last checkpoint."""
    from hma_jax.training.reading import CheckpointError
    from hma_jax.training.runs import load_run

    try:
        trained = load_run(source, "auto")
    except CheckpointError as error:
        raise ConfigError(
            f"the trial goes on from another one, of which no checkpoint is here ({error}); remove {source.parent} to "
            "have that one trained again"
        ) from error
    wanted = trial.source.train.steps
    if trained.step != wanted:
        raise ConfigError(f"the trial goes on from another one that has {trained.step} of {wanted} steps: {source}")
    return add_robots(trained, trial, prepared)
