"""Runs on disk: how their checkpoints describe them, and how they are read."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np

from hma_jax.config import ExecutionConfig, ModelConfig, TrainConfig, Weights, require
from hma_jax.config.base import require_choice
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.config.training import PREDICT_FRAMES
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Declared, Params, inference_params, path_name, require_params
from hma_jax.runtime.devices import default_device
from hma_jax.runtime.processes import broadcast_from_writer, is_writer
from hma_jax.training.hashes import ReadError
from hma_jax.training.reading import (
    CheckpointError,
    agree_on_latest,
    has_item,
    load_items,
    on_host,
    raised_in_all,
    read_description,
    require_finished,
)
from hma_jax.training.run_lock import CHECKPOINTS

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """A trained model, read from its run directory."""

    model: ModelConfig
    train: TrainConfig
    table: EmbodimentTable
    params: Params = field(repr=False)
    step: int
    provenance: dict[str, Any]
    weights: Weights = "last"  # which of the run's weights `params` are: last or ema

    @property
    def finished(self) -> bool:
        """Whether all steps of its training were made. A converted model has step 0 and counts as finished."""
        return not 0 < self.step < self.train.steps


@dataclass(frozen=True, eq=False)  # compared by identity, so that it can be hashed, which a tree of arrays cannot
class Model:
    """A trained model, ready for inference: inside a traced function, `declared.merge(params)` is the module that
    computes.

    It can be pickled; unpickled, its parameters are on the default device.
    """

    run: Run  # with parameters from `model.params.inference_params`; for conversion use `load_run`
    declared: Declared[HMA]
    execution: ExecutionConfig

    @property
    def config(self) -> ModelConfig:
        return self.run.model

    @property
    def table(self) -> EmbodimentTable:
        return self.run.table

    @property
    def params(self) -> Params:
        """The parameters, on this process's default device."""
        return self.run.params

    @property
    def step(self) -> int:
        return self.run.step

    @cached_property
    def identity(self) -> str:
        """A hash of the settings, the table and the parameters, for which the parameters are read from their device
        once."""
        digest = hashlib.sha256(stable_hash([self.config, self.table]).encode())
        for path, array in jax.tree.leaves_with_path(self.params):
            digest.update(path_name(path).encode())
            digest.update(np.asarray(array).tobytes())
        return digest.hexdigest()[:16]

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.run, self.execution)


def _rebuild(run: Run, execution: ExecutionConfig) -> Model:
    return Model(run, declare_model(run.model, run.table, execution), execution)


def describe_run(
    model: ModelConfig, train: TrainConfig, table: EmbodimentTable, provenance: dict[str, Any]
) -> dict[str, Any]:
    """The JSON description that every checkpoint of a run carries."""
    return {
        "model": to_dict(model),
        "train": to_dict(train),
        "table": to_dict(table),
        "provenance": provenance,
    }


def read_configs(described: dict[str, Any], where: str) -> tuple[ModelConfig, TrainConfig, EmbodimentTable]:
    """The configurations of a run, from a description that this or an earlier version wrote.

    A field that it lacks has the value that computes what was computed without it (`config.base.later`). Raises
    ConfigError, which begins with `where`, for a field that this version does not know.
    """

    def read(name: str, kind: type) -> Any:
        return from_dict(kind, described[name], f"{where}: {name}")

    return read("model", ModelConfig), read("train", TrainConfig), read("table", EmbodimentTable)


def modernise(described: dict[str, Any]) -> dict[str, Any]:
    """A description that this or an earlier version wrote, in the form that `describe_run` writes. Raises as
    `read_configs`."""
    return describe_run(*read_configs(described, "the checkpoint"), described["provenance"])


def require_frames(run: Run, deed: str) -> None:
    """Raises ConfigError for a model that was trained to predict actions only; `deed` is the verb for the message."""
    masking = run.train.masking
    require(
        masking.predicts_frames,
        f"the model was trained with train.masking.setting {masking.setting!r}, which predicts no frames, so there "
        f"are none to {deed}. Use a model that was trained with one of {', '.join(PREDICT_FRAMES)}; `hma evaluate` "
        "can evaluate the predicted actions of this one",
    )


def load_run(run_dir: str | Path, weights: Weights = "last") -> Run:
    """The parameters and description in a run's latest checkpoint; the moments are not read.

    The parameters are in host memory, as NumPy arrays: one device may be too small for them. If the run is being
    trained and removes the checkpoint while it is read, a newer one is taken. With several processes all call this, and
    read the same checkpoint. Raises CheckpointError if there is no checkpoint, or it is damaged or of another kind,
    ReadError if it cannot be read at the moment, and ConfigError for weights that the run does not keep, or an unknown
    name of weights. A shipped model keeps one item of weights: their average if `train.ema_decay` is not 0. Logs a
    warning, once per run and step, for a model whose training is not finished.
    """
    require_choice(weights, get_args(Weights), "weights")
    run_dir = Path(run_dir)
    directory = run_dir.absolute() / CHECKPOINTS
    step = agree_on_latest(directory)
    if step is None:
        found = "no finished checkpoint under" if directory.is_dir() else "no checkpoints at"
        inside = [str(place.parent) for place in run_dir.glob(f"model/{CHECKPOINTS}")]
        inside += sorted(str(place.parent) for place in run_dir.glob(f"trials/*/run/{CHECKPOINTS}"))
        runs = f", such as {' or '.join(inside[:2])}" if inside else ""
        raise CheckpointError(
            f"{found} {directory}; give the directory of a training run that has saved a checkpoint{runs}"
        )
    while True:
        try:
            run = _read_run(run_dir, directory / str(step), weights)
            if not run.finished and is_writer():
                _warn_of_unfinished(str(run_dir), run.step, run.train.steps)
            return run
        except (CheckpointError, ReadError):  # NFS says that a file cannot be read if another host removed it
            read, step = step, agree_on_latest(directory)
            if step in (None, read):
                raise


@cache
def _warn_of_unfinished(run_dir: str, step: int, steps: int) -> None:
    log.warning(
        "%s is at step %s of %s: its training is not finished. Run the command that trains it again to continue",
        run_dir, f"{step:,}", f"{steps:,}",
    )  # fmt: skip


def _read_run(run_dir: Path, checkpoint: Path, weights: Weights) -> Run:
    require_finished(checkpoint)
    with raised_in_all("description"):
        described = read_description(checkpoint)
        missing = {"model", "train", "table", "provenance"} - set(described)
        if missing:
            raise CheckpointError(
                f"{run_dir}: not a run of this project (no {', '.join(sorted(missing))}); give the directory "
                "of a training run"
            )
        averaged = has_item(checkpoint, "ema")
    averaged = bool(broadcast_from_writer("average", "kept" if averaged else ""))  # all read the same item
    model, train, table = read_configs(described, str(run_dir))
    alone = train.ema_decay > 0 and not averaged  # shipped: `params` are the average
    require(
        averaged or alone or weights != "ema",
        f"{run_dir} keeps no average of its weights (train.ema_decay is 0); use the last weights",
    )
    require(
        not alone or weights != "last", f"{run_dir} keeps only the average of its weights, not the last ones; use ema"
    )
    item = "ema" if averaged and weights != "last" else "params"
    declared = declare_model(model, table)
    with raised_in_all("parameters"):
        params = load_items(checkpoint, {item: on_host(declared.shapes())})[item]
    require_params(declared, params, f"{checkpoint} is not of the model that it describes")
    return Run(
        model,
        train,
        table,
        params,
        int(checkpoint.name),
        described["provenance"],
        "ema" if item == "ema" or alone else "last",
    )


def load_model(run_dir: str | Path, execution: ExecutionConfig = ExecutionConfig(), weights: Weights = "auto") -> Model:
    """The model in a run's latest checkpoint, to be computed as `execution` says; its parameters are cast once, here.

    `weights` are the last ones, their moving average (`ema`), or the average where the run keeps one
    (`auto`). Raises as `load_run`, and ConfigError if `execution` is not an ExecutionConfig.
    """
    require(
        isinstance(execution, ExecutionConfig),
        f"execution is an ExecutionConfig, such as ExecutionConfig(dtype='bfloat16'), got {execution!r}",
    )
    run = load_run(run_dir, weights)
    params = inference_params(declare_model(run.model, run.table, execution), run.params, execution.dtype)
    return _rebuild(replace(run, params=jax.device_put(params, default_device())), execution)
