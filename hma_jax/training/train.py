"""Training a model: puts state, mesh, step and loop together, and reads runs back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from hma_jax.config import ExecutionConfig, MeshConfig, ModelConfig, TrainConfig
from hma_jax.config.json import from_dict, to_dict
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.flops import peak_flops, train_flops_per_window
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Declared, Params
from hma_jax.runtime.sharding import audit_sharding, make_mesh, param_shardings, plan_sharding, put_batch
from hma_jax.training.checkpoints import CheckpointError, read_checkpoint
from hma_jax.training.loop import FitResult, LoopOptions, Progress, fit
from hma_jax.training.optimizer import AdamState
from hma_jax.training.state import TrainState
from hma_jax.training.step import init_state, make_train_step


@dataclass(frozen=True)
class Run:
    """A trained model, read from its run directory."""

    model: ModelConfig
    train: TrainConfig
    table: EmbodimentTable
    params: Params
    step: int
    provenance: dict[str, Any]


def train_model(
    model: ModelConfig,
    table: EmbodimentTable,
    config: TrainConfig,
    make_batches: Callable[[int], Iterator[dict[str, np.ndarray]]],
    *,
    run_dir: Path,
    provenance: dict[str, Any],
    execution: ExecutionConfig = ExecutionConfig(),
    options: LoopOptions = LoopOptions(),
    progress: Progress | None = None,
    initial: Params | None = None,
) -> FitResult:
    """Trains to `config.steps`, resuming what is in `run_dir`.

    `make_batches(start)` yields this process's rows of the global batches from step `start`
    on. A new run starts from `initial` parameters, or from a draw. `provenance` says what data
    the batches come from; resuming on other data is refused. `execution` says how it is computed, and may
    be another one each time. Raises ConfigError, CheckpointError, DivergedError, Interrupted.
    """
    declared = declare_model(model, table, execution)
    mesh = execution.mesh
    device_mesh = make_mesh(mesh)
    audit_sharding(plan_sharding(declared, device_mesh, mesh), device_mesh)
    shardings = state_shardings(declared, device_mesh, mesh)
    with jax.set_mesh(device_mesh):
        state = init_state(declared, table, config.seed, shardings, initial)
        step = jax.jit(
            make_train_step(declared, table, model, config, execution.accumulate),
            donate_argnums=0,
            out_shardings=(shardings, None),
        )
        # A constant rate does not depend on the number of steps: such a run may go on.
        extendable = ("train.steps",) if config.optimizer.schedule == "constant" else ()
        return fit(
            step,
            state,
            make_batches,
            steps=config.steps,
            run_dir=run_dir,
            meta=describe_run(model, config, table, provenance),
            put_batch=lambda batch: put_batch(batch, device_mesh),
            options=replace(
                options,
                flops_per_step=config.batch * train_flops_per_window(model, table),
                peak_flops=peak_flops(execution.dtype),
                may_change=extendable,
            ),
            progress=progress,
        )


def state_shardings(declared: Declared, device_mesh: jax.sharding.Mesh, mesh: MeshConfig) -> TrainState:
    """Shardings of a whole state: moments lie as their parameters, counters on every device."""
    whole = NamedSharding(device_mesh, PartitionSpec())
    params = param_shardings(declared, device_mesh, mesh)
    return TrainState(whole, params, AdamState(params, params, whole, whole))


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


def load_run(run_dir: Path) -> Run:
    """The latest checkpoint of a run. Raises CheckpointError if there is none or it is foreign."""
    step, state, meta = read_checkpoint(Path(run_dir) / "checkpoints")
    missing = {"model", "train", "table", "provenance"} - set(meta)
    if missing:
        raise CheckpointError(
            f"{run_dir}: not a run of this project (no {', '.join(sorted(missing))}); give the directory "
            "of a training run"
        )
    return Run(
        from_dict(ModelConfig, meta["model"], f"{run_dir}: model"),
        from_dict(TrainConfig, meta["train"], f"{run_dir}: train"),
        from_dict(EmbodimentTable, meta["table"], f"{run_dir}: table"),
        state["params"] if isinstance(state, dict) else state.params,
        step,
        meta["provenance"],
    )
