"""A trained model that is given new robots: what training goes on from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from experiments.running.run_trial import Materials
from experiments.running.trial import Trial, loader_of
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from hma_jax.model.embodiments import EmbodimentTable
    from hma_jax.model.params import Params
    from hma_jax.training.runs import Run


class Beginning(TypedDict):
    """What `train_trial` takes for a model that is not new."""

    table: EmbodimentTable
    initial: Params
    origin: dict[str, Any]


def add_robots(trained: Run, trial: Trial, materials: Materials) -> Beginning:
    """`trained` with slices for those of the trial's datasets that it does not know, drawn from the trial's seed."""
    from data_pipelines.loading.selection import training_embodiment
    from hma_jax.training.adapt import add_embodiments

    loader, scale = loader_of(trial), trial.train.action_scale
    new = [name for name in trial.datasets if name not in trained.table.names]
    robots = [training_embodiment(materials.store, name, loader, scale) for name in new]
    params, table = add_embodiments(trained.params, trained.model, trained.table, robots, trial.train.seed)
    return Beginning(table=table, initial=params, origin={"step": trained.step, "provenance": trained.provenance})


def begin_from_trial(trial: Trial, source: Path, materials: Materials) -> Beginning:
    """The beginning of a trial that has a source, whose training run is in `source`. Raises ConfigError without its
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
    return add_robots(trained, trial, materials)
