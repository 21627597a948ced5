"""Held-out loss during training, on the same windows and masks each time; it is not part of a run's identity."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hma_jax.config import ExecutionConfig, MaskingConfig, ModelConfig, check_micro_batches, require
from hma_jax.kernels.random import key_of
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Declared, Params
from hma_jax.objective.losses import LossSums, TargetCounts, loss_metrics, noise_keys
from hma_jax.objective.masking import mask_batch
from hma_jax.runtime.processes import compiled_by_all
from hma_jax.runtime.rows import split_rows
from hma_jax.runtime.sharding import replicated
from hma_jax.training.loop import ValidationHook
from hma_jax.training.state import TrainState
from hma_jax.training.step import TRAINING_ARRAYS, loss_of_rows

SEED = 0
"""Seed of masks and noise, the same for every run, so that runs with the same masking can be compared."""


@dataclass(frozen=True)
class Validation:
    """What a run is validated on.

    `batches()` yields this process's rows of a few global batches, as large as in training, perhaps with `valid`
    bool [B] (False: a padding row) and `real` bool [B, T] (False: a padding frame). A batch of a single dataset may
    name it as `dataset`. The batches are read once; the windows stay in host memory.
    """

    every: int  # steps
    batches: Callable[[], Iterable[Mapping[str, Any]]]

    def __post_init__(self):
        require(self.every >= 1, f"the number of steps between validations must be at least 1, got {self.every}")


def make_validation_hook(
    validation: Validation,
    model: ModelConfig,
    table: EmbodimentTable,
    masking: MaskingConfig,
    execution: ExecutionConfig,
    put_batch: Callable[[Any], Any],
) -> ValidationHook:
    """Measures `loss` (and its parts) for the parameters and, as `ema_loss`, for their average if there is one. If
    batches name several datasets, it also measures the loss of each, as `loss/NAME`."""
    compute = _jitted_sums(model, table, masking, execution, jax.sharding.get_mesh())
    held: list[dict[str, np.ndarray]] = []
    datasets: list[str] = []  # of each batch; "" where it does not name one

    def mean(params: Params) -> dict[str, float]:
        rows = jax.device_get([compute(params, put_batch(batch), np.int32(n)) for n, batch in enumerate(held)])

        def over(chosen: Sequence[Any]) -> dict[str, float]:
            sums, counts = jax.tree.map(lambda *x: float(sum(x)), *chosen)
            counts = TargetCounts(*(max(n, 1) for n in counts))
            return loss_metrics(sums, counts, masking, discrete=not model.diffusion)

        names = [name for name in dict.fromkeys(datasets) if name]
        each = {name: [row for row, of in zip(rows, datasets, strict=True) if of == name] for name in names}
        return over(rows) | {f"loss/{name}": over(each[name])["loss"] for name in names if len(names) > 1}

    def measure(state: TrainState) -> dict[str, float]:
        nonlocal compute
        if not held:
            for batch in validation.batches():
                held.append(_with_valid(batch))
                datasets.append(batch.get("dataset", ""))
            require(bool(held), "there is no window to validate on; switch off validation")
            compute = compiled_by_all("validation", compute, state.params, put_batch(held[0]), np.int32(0))
        values = mean(state.params)
        if state.ema is not None:
            values |= {f"ema_{name}": value for name, value in mean(state.ema).items()}
        return values

    return ValidationHook(validation.every, measure)


@lru_cache(maxsize=4)
def _jitted_sums(
    model: ModelConfig, table: EmbodimentTable, masking: MaskingConfig, execution: ExecutionConfig, device_mesh: Mesh
) -> Callable:
    """`make_sums`, compiled for a mesh, which may be empty; kept for the next run in the same process, like the
    step."""
    layout = None if device_mesh.empty else replicated(device_mesh)
    declared = declare_model(model, table, execution)
    return jax.jit(make_sums(declared, table, model, masking, execution.accumulate), out_shardings=layout)


def make_sums(
    declared: Declared[HMA], table: EmbodimentTable, model: ModelConfig, masking: MaskingConfig, accumulate: int = 1
) -> Callable[[Params, Mapping[str, jax.Array], jax.Array], tuple[LossSums, TargetCounts]]:
    """sums(params, batch, number) -> loss sums and target counts over the batch's valid rows; a pure function.

    The batch is split into as many micro-batches as a training step's, so it fits into memory if a step does. Settings
    that weigh targets or degrade the past only in training are switched off, so that runs with different values of them
    can be compared. Masks, random ids and label smoothing are those of training.
    """
    masking = replace(masking, change_weight=1.0, own_past=0.0, own_past_rounds=1, displaced_past=0.0)

    def sums(params: Params, batch: Mapping[str, jax.Array], number: jax.Array) -> tuple[LossSums, TargetCounts]:
        key = jax.random.fold_in(key_of(SEED), number)
        valid_B, real_BT = batch["valid"], batch.get("real")
        masked = mask_batch(key, batch["tokens"], batch["embodiment"], model, masking, table, real_BT)
        masked = masked.without_padding(jnp.broadcast_to(valid_B[:, None], masked.action_hidden_T.shape))
        rows = {name: batch[name] for name in TRAINING_ARRAYS if name in batch}
        rows |= {"masked": masked, "key": noise_keys(key, len(valid_B))}

        def of_rows(one: dict[str, Any]) -> LossSums:
            return loss_of_rows(declared.merge(params), one, masking, training=False)

        if accumulate == 1:
            found = of_rows(rows)
        else:
            check_micro_batches(len(valid_B), accumulate)
            found = jax.tree.map(jnp.sum, jax.lax.map(of_rows, split_rows(rows, accumulate)))
        return found, TargetCounts(jnp.sum(masked.targets_TS), jnp.sum(masked.action_targets_T))

    return sums


def _with_valid(batch: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    names = [name for name in TRAINING_ARRAYS if name in batch]
    everything = np.ones(len(batch["tokens"]), bool)
    return {name: batch[name] for name in names} | {"valid": batch.get("valid", everything)}
