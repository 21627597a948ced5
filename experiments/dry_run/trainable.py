"""Checks before anything is made, of settings under which trials would fail or differ from their description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from experiments.declared_table import declared_table
from experiments.dry_run.done import UNKNOWN
from experiments.running.launchers.registry import LauncherOptions
from experiments.study import Study
from experiments.sweeps.sweep import Sweep, unique_trials
from experiments.terminal.words import few
from hma_jax.config import ConfigError, MeshConfig, TrainConfig, require


def require_trainable(study: Study, sweeps: Sequence[Sweep], launcher_options: LauncherOptions) -> None:
    """Raises ConfigError for a trial that would fail once everything is prepared (`check_launched`)."""
    if launcher_options.share() is None and launcher_options.name == "local":  # the devices that JAX finds
        import jax

        check_trials(study, sweeps, float(jax.device_count()))
    else:
        check_launched(study, sweeps, launcher_options)


def check_launched(study: Study, sweeps: Sequence[Sweep], launcher_options: LauncherOptions) -> float:
    """`check_trials` with what the launcher gives each trial. If that is too much of this machine, the error says how
    many --workers may share it."""
    share = launcher_options.share()
    try:
        return check_trials(study, sweeps, share)
    except ConfigError as error:
        if share is None or launcher_options.name != "local":
            raise
        devices = share * (launcher_options.workers or 1)
        several = replace(launcher_options, workers=int(devices) // study.execution.mesh.min_devices)
        try:
            check_trials(study, sweeps, several.share())
        except ConfigError:
            raise error from None
        raise ConfigError(
            f"{error}; or run several trials at a time, each on its part of this machine: --workers {several.workers}"
        ) from error


def devices_of(mesh: MeshConfig, share: float | None) -> float:
    """Number of devices that a program uses of its `share`; if that is unknown, the least number that the mesh needs.

    Raises ConfigError for a mesh that does not fit them, as training would.
    """
    from hma_jax.runtime.mesh import mesh_sizes

    share = share or float(mesh.min_devices)
    mesh_sizes(mesh, math.ceil(share))
    return share


def check_trials(study: Study, sweeps: Sequence[Sweep], share: float | None) -> float:
    """`devices_of` each trial. Raises ConfigError also for a trial whose batch or model does not divide over them,
    whose learning rate would not do what its description says, or that is to train only robots that it does not have or
    that have no parameters of their own."""
    from hma_jax.runtime.mesh import check_sizes, mesh_sizes
    from hma_jax.training.optimizer import check_schedule

    execution = study.execution
    devices = devices_of(execution.mesh, share)
    sizes = mesh_sizes(execution.mesh, math.ceil(devices))
    for trial in unique_trials(sweeps, UNKNOWN).values():
        check_sizes(sizes, trial.model, trial.train.batch, execution.accumulate)
        check_schedule(trial.train.optimizer, trial.train.steps)
        if trial.source:  # each is judged as a robot to which the model was adapted
            _require_actions(trial.train.only, trial.rate)
        require_only(trial.train, [name for one in trial.with_source() for name in one.datasets], trial.rate)
    return devices


def _require_actions(robots: Sequence[str], rate: float | None) -> None:
    without = [name for name in robots if not declared_table((name,), rate).entries[0].chunk]
    require(
        not without,
        f"{few(without)}: a model cannot be adapted to robots without actions, because all of a robot's own "
        "parameters are for actions; leave them out (the axis fewshot adapts to --set unseen=...)",
    )


def require_only(train: TrainConfig, robots: Sequence[str], rate: float | None) -> None:
    """Raises ConfigError, as training would, if `train.only` names robots that are not among the `robots` that a model
    is trained on, or if none of those named has parameters of its own to train."""
    without = [name for name in train.only if name not in robots]
    require(not without, f"train.only: the study has no robot {few(without)}, but {few(robots)}")
    if train.only:
        from hma_jax.training.step import check_own

        check_own(declared_table(train.only, rate).entries, train.masking)
