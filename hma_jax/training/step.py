"""One optimiser step as a pure function: masks, gradients, accumulation, update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from einops import rearrange

from hma_jax.config import ModelConfig, TrainConfig
from hma_jax.embodiments import EmbodimentTable
from hma_jax.objectives import LossSums, mask_batch, masked_loss
from hma_jax.params import Declared, is_spec
from hma_jax.training.optimizer import (
    apply_adamw,
    clip_by_global_norm,
    init_adam,
    learning_rate_multiplier,
    make_schedule,
)
from hma_jax.training.state import TrainState

Batch = dict[str, jax.Array]
"""tokens int32 [B, T, S], actions float32 [B, T, U] (raw, zero-padded), embodiment int32 [B]."""


def init_state(
    declared: Declared, table: EmbodimentTable, seed: int, shardings: TrainState | None = None
) -> TrainState:
    """The state before step 1, laid out by `shardings` (default: on one device)."""
    params = declared.init(seed, shardings and shardings.params)
    state = TrainState(jnp.zeros((), jnp.int32), params, init_adam(params, table.size))
    return jax.device_put(state, shardings)


def make_train_step(
    declared: Declared, table: EmbodimentTable, model: ModelConfig, config: TrainConfig
) -> Callable[[TrainState, Batch], tuple[TrainState, dict[str, jax.Array]]]:
    """step(state, batch) -> (state, metrics), to be jitted with the state donated.

    The loss is the mean over all masked positions of the global batch, whatever the number of
    micro-batches. Randomness is fold_in(seed, step), then the example's row.
    """
    schedule = make_schedule(config.optimizer, config.steps)
    multipliers = jax.tree.map(
        lambda spec: learning_rate_multiplier(spec, model), declared.specs, is_leaf=is_spec
    )

    def sums(params: Any, batch: Batch, key: jax.Array) -> tuple[jax.Array, LossSums]:
        masked = mask_batch(key, batch["tokens"], batch["row"], model, config.masking)
        result = masked_loss(
            declared.merge(params),
            masked,
            batch["tokens"],
            batch["actions"],
            batch["embodiment"],
            config.masking.label_smoothing,
        )
        return result.loss, result

    def accumulated(params: Any, batch: Batch, key: jax.Array) -> tuple[Any, LossSums]:
        gradient = jax.grad(sums, has_aux=True)
        if config.accumulate == 1:
            return gradient(params, batch, key)
        # Micro-batch a takes rows a, a + A, ...: every device keeps the rows it has.
        micro = jax.tree.map(lambda x: rearrange(x, "(b a) ... -> a b ...", a=config.accumulate), batch)
        zero = jax.tree.map(jnp.zeros_like, params)

        def body(carry: tuple[Any, LossSums], one: Batch) -> tuple[tuple[Any, LossSums], None]:
            return jax.tree.map(jnp.add, carry, gradient(params, one, key)), None

        (grads, total), _ = jax.lax.scan(body, (zero, LossSums(*[jnp.zeros(())] * 3)), micro)
        return grads, total

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, dict[str, jax.Array]]:
        key = jax.random.fold_in(jax.random.key(config.seed), state.step)
        batch = batch | {"row": jnp.arange(config.batch)}
        grads, total = accumulated(state.params, batch, key)
        count = jnp.maximum(total.count, 1.0)
        grads = jax.tree.map(lambda g: g / count, grads)
        grads, norm = clip_by_global_norm(grads, config.optimizer.clip_norm)
        present_E = jnp.zeros(table.size, bool).at[batch["embodiment"]].set(True)
        rate = schedule(state.step)
        params, opt_state = apply_adamw(
            grads,
            state.opt_state,
            state.params,
            declared.specs,
            multipliers,
            present_E,
            rate,
            config.optimizer,
        )
        metrics = {
            "loss": total.loss / count,
            "accuracy": total.correct / count,
            "grad_norm": norm,
            "learning_rate": rate,
        }
        return TrainState(state.step + 1, params, opt_state), metrics

    return step
