"""Training a model: puts state, mesh, step and loop together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from hma_jax.config import ExecutionConfig, ModelConfig, TrainConfig, require
from hma_jax.config.base import require_shapes
from hma_jax.config.json import to_dict
from hma_jax.kernels.random import key_of
from hma_jax.model.embodiments import EmbodimentTable, normalise
from hma_jax.model.flops import train_flops_per_step
from hma_jax.model.given import require_below
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params
from hma_jax.runtime.audit import audit_sharding, plan_sharding
from hma_jax.runtime.devices import peak_flops
from hma_jax.runtime.mesh import check_mesh, make_mesh
from hma_jax.runtime.rows import own_rows
from hma_jax.runtime.sharding import put_batch, replicated
from hma_jax.training import branch
from hma_jax.training.divergence import Records
from hma_jax.training.loop import FitResult, LoopOptions, Progress, RunInfo, fit
from hma_jax.training.optimizer import steps_in_common
from hma_jax.training.runs import describe_run, modernise
from hma_jax.training.state import init_state, state_shapes
from hma_jax.training.step import make_train_step
from hma_jax.training.validation import Validation, make_validation_hook


def train_model(
    model: ModelConfig,
    table: EmbodimentTable,
    config: TrainConfig,
    make_batches: Callable[[int], Iterable[dict[str, np.ndarray]]],
    *,
    run_dir: str | Path,
    provenance: dict[str, Any],
    execution: ExecutionConfig = ExecutionConfig(),
    options: LoopOptions = LoopOptions(),
    validation: Validation | None = None,
    progress: Progress | None = None,
    initial: Params | None = None,
    records: Records = lambda index: (),
) -> FitResult:
    """Trains to `config.steps`, resuming the run in `run_dir` if there is one.

    `make_batches(start)` gives this process's rows (`runtime.rows.own_rows`) of the global batches from step `start`
    on. A new run starts from a copy of the `initial` parameters, or from randomly drawn ones. `provenance` says what
    data the batches come from; resuming on other data is refused. `execution` and `validation` may differ when a run
    resumes. `records` names the records of a batch, for the message when its step is not finite. Raises ConfigError,
    CheckpointError, SaveError, DivergedError, Interrupted.
    """
    declared = declare_model(model, table, execution)
    mesh = execution.mesh
    device_mesh = make_mesh(mesh)
    check_mesh(device_mesh, model, config.batch, execution.accumulate)
    audit_sharding(plan_sharding(declared, device_mesh, mesh), device_mesh)
    shapes = state_shapes(declared, table, device_mesh, mesh, average=config.ema_decay > 0, only=config.only)

    rows = len(own_rows(device_mesh, config.batch))
    # Runs that differ only in their seed or in the statistics of their robots' actions share one compiled step: the
    # seed is part of the batch, and the host normalises the actions. With action heads the statistics are constants of
    # the program instead, because the loss would differ in its last bits if its targets were normalised on the host. In
    # evaluation they are inputs of the program (`HMA.with_action_units`). In training they are not: every result
    # depends on the last bits of its steps, and it has not been shown on every platform that these would stay the same.
    scale, program_table = (None, table) if model.action_heads else (table.scale(), table.standardised())

    def put(batch: Any) -> Any:
        return put_batch(batch if scale is None else _normalised(batch, scale), device_mesh)

    padded: set[bool] = set()  # whether batches have `real`

    def put_checked(batch: Any) -> Any:
        check_batch(batch, rows, model, table)
        padded.add("real" in batch)
        require(len(padded) == 1, "some batches have `real`, the marks of padding, and some do not; give it with all")
        return put(batch) | {"seed": seed}

    branched = branch.read_branchings(Path(run_dir))
    if branched:
        provenance = provenance | {"branched": branched}

    with jax.set_mesh(device_mesh):
        step = _jitted_step(make_train_step, model, program_table, replace(config, seed=0), execution, device_mesh)
        seed = jax.device_put(jax.random.key_data(key_of(config.seed)), replicated(device_mesh))

        return fit(
            step,
            shapes,
            lambda: init_state(declared, table, config.seed, shapes, initial),
            make_batches,
            steps=config.steps,
            run_dir=run_dir,
            info=RunInfo(describe_run(model, config, table, provenance), to_dict(execution), modernise, records),
            put_batch=put_checked,
            options=replace(
                options,
                flops_per_step=train_flops_per_step(model, table, config),
                peak_flops=peak_flops(execution.dtype),
                may_change=partial(_may_change, config, branched),
            ),
            validation=validation
            and make_validation_hook(validation, model, program_table, config.masking, execution, put),
            progress=progress,
        )


def _may_change(
    config: TrainConfig, branched: list[dict[str, Any]], saved: dict[str, Any], step: int
) -> tuple[str, ...]:
    """The fields that may differ when a run resumes, as `LoopOptions.may_change`. The number of steps may change if the
    checkpoint is at a step up to which the learning rate does not depend on it, and is not beyond the new number. A
    branch, at the step of its branching, may change much else."""
    if branched and step == branched[-1]["step"] <= config.steps:
        return branch.MAY_CHANGE
    same = steps_in_common(config.optimizer, saved["train"]["steps"], config.steps)
    return ("train.steps",) if step <= min(same, config.steps) else ()


def check_batch(batch: Mapping[str, np.ndarray], rows: int, model: ModelConfig, table: EmbodimentTable) -> None:
    """Raises ConfigError for a host batch that is not as `step.Batch` says, or does not have `rows` rows.

    Without this check a step would compute with ids and robots that do not exist, with fewer rows than
    `TrainConfig.batch` says, and with marks of padding that are not those of its frames.
    """
    wanted = {
        "tokens": (rows, model.frames, *model.frame_shape),
        "actions": (rows, model.frames, table.action_width),
        "embodiment": (rows,),
    }
    if "real" in batch:
        wanted["real"] = rows, model.frames
    require_shapes("a batch of this run has", {name: batch.get(name) for name in wanted}, wanted)
    numbers = {"embodiment": ("robots", table.size)}
    if not model.diffusion:
        numbers["tokens"] = "ids", model.vocab_size
    for name, (what, count) in numbers.items():
        kind = batch[name].dtype
        require(np.issubdtype(kind, np.integer), f"a batch has {what} of type {kind}, not integers")
        require_below(count, batch[name], f"a batch has {what}")
    if "real" in batch:
        kind = batch["real"].dtype
        require(np.issubdtype(kind, np.bool_), f"a batch has marks of padding, `real`, of type {kind}, not bool")


def _normalised(batch: Mapping[str, np.ndarray], scale: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """A host batch with its actions normalised as by `ActionUnits.normalise`; `scale` is the table's."""
    of_rows = [x[batch["embodiment"]][:, None] for x in scale]
    return {**batch, "actions": normalise(np.asarray(batch["actions"], np.float32), *of_rows, xp=np)}


@lru_cache(maxsize=4)
def _jitted_step(
    make: Callable[..., Callable],
    model: ModelConfig,
    table: EmbodimentTable,
    config: TrainConfig,
    execution: ExecutionConfig,
    device_mesh: Mesh,
) -> Callable:
    """The compiled step of `make`, for runs of any seed: the seed is part of the batch. With a `table` that is
    standardised the actions come normalised. `make` is `make_train_step`, or what a test puts in its place; it is an
    argument so that the two have separate cache entries.

    The step is kept for the next run in the same process, which is often the same run, resumed, or one with another
    seed: tracing and compiling a step takes seconds.
    """
    declared = declare_model(model, table, execution)
    shapes = state_shapes(declared, table, device_mesh, execution.mesh, average=config.ema_decay > 0, only=config.only)
    return jax.jit(
        make(declared, table, model, config, execution.accumulate),
        donate_argnums=0,
        # Metrics are replicated, so that every process can read them.
        out_shardings=(jax.tree.map(lambda x: x.sharding, shapes), replicated(device_mesh)),
    )
