"""Training of small networks: one jitted step on arrays in memory, checkpoints at several steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hma_jax.config import require
from hma_jax.kernels.random import key_of

Report = Callable[[int, int, str], None]
"""Called as report(done, total, note)."""


@dataclass(frozen=True)
class FitConfig:
    """AdamW with a warm-up and a cosine decay, float32. Parameters are kept after each of the steps `keep`, and after
    the last one; if `ema` > 0, their exponential moving average."""

    steps: int = 3000
    batch: int = 64
    learning_rate: float = 2e-3
    warmup: int = 50
    weight_decay: float = 1e-4
    ema: float = 0.995
    keep: tuple[int, ...] = ()

    def __post_init__(self):
        require(self.steps >= 1 and self.batch >= 1, "steps and batch of training must be at least 1")
        require(
            all(0 <= k <= self.steps for k in self.keep), f"steps to keep must lie in 0..{self.steps}, got {self.keep}"
        )
        require(0 <= self.ema < 1, f"ema must lie in [0, 1), got {self.ema}")


def fit(
    params: Any,
    loss: Callable[[Any, Mapping[str, jax.Array], jax.Array, jax.Array], jax.Array],
    data: Mapping[str, np.ndarray],
    examples: int,
    config: FitConfig,
    seed: int,
    report: Report,
) -> dict[int, Any]:
    """{step: parameters} for every step that is kept, including the last.

    `loss(params, data, index [B], key)` is the mean over the examples `index` of `data`, all of which is in memory.
    Step n draws its batch from `fold_in(key(seed), n)`. The average of parameters forgets the first ones sooner.
    """
    schedule = optax.warmup_cosine_decay_schedule(
        0, config.learning_rate, config.warmup, max(config.steps, config.warmup + 1)
    )
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=config.weight_decay))
    arrays = {name: jnp.asarray(values) for name, values in data.items()}
    root = key_of(seed)

    @jax.jit
    def step(params: Any, average: Any, state: Any, n: jax.Array, arrays: Mapping[str, jax.Array]):
        draw, noise = jax.random.split(jax.random.fold_in(root, n))
        index = jax.random.randint(draw, (config.batch,), 0, examples, jnp.int32)
        value, grads = jax.value_and_grad(loss)(params, arrays, index, noise)
        updates, state = optimizer.update(grads, state, params)
        params = optax.apply_updates(params, updates)
        decay = jnp.minimum(config.ema, n / (n + 10.0))
        average = jax.tree.map(lambda a, p: decay * a + (1 - decay) * p, average, params)
        return params, average, state, value

    keep, kept = {*config.keep, config.steps}, {}
    average, state = params, optimizer.init(params)
    if 0 in keep:
        kept[0] = jax.device_get(average)
    losses: list[jax.Array] = []
    for n in range(config.steps):
        params, average, state, value = step(params, average, state, jnp.int32(n), arrays)
        losses.append(value)
        if n + 1 in keep:
            kept[n + 1] = jax.device_get(average)
        if (n + 1) % 50 == 0 or n + 1 == config.steps:
            recent = float(np.mean([np.asarray(x) for x in losses[-50:]]))
            require(np.isfinite(recent), f"the loss is not finite after {n + 1} steps; lower the learning rate")
            losses = []
            report(n + 1, config.steps, f"loss {recent:.4f}")
    return kept


def log_spaced_steps(steps: int, count: int, first: int = 20) -> tuple[int, ...]:
    """`count` steps of training from `first` to `steps`, evenly spaced in the logarithm."""
    require(count >= 2, f"checkpoints from {first} to {steps} steps are at least 2, got {count}")
    require(
        steps > first,
        f"the first checkpoint is at {first} steps, so training must be longer than that, got {steps} steps",
    )
    return tuple(sorted({round(first * (steps / first) ** (i / (count - 1))) for i in range(count)}))
