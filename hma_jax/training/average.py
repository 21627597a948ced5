"""An exponential moving average of the weights, for inference: it is smoother than the last weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.model.params import Params


def warmup_decay(updates: int | jax.Array) -> float | jax.Array:
    """Upper bound on the decay after n `updates`, int []: (1 + n) / (10 + n), the warm-up of TensorFlow's
    ExponentialMovingAverage(num_updates=n)."""
    return (1 + updates) / (10 + updates)


def update_average(ema: Params, params: Params, decay: float, updates: jax.Array) -> Params:
    """d * ema + (1 - d) * params, for the parameters of all robots, including those without an example in the step.

    The average starts as a copy of the initial parameters. d rises to `decay` with the number of `updates` before this
    one, int [] (`warmup_decay`), because with `decay` alone the average of a short run would consist largely of
    untrained weights. All entries average over the same steps. If a robot's parameters were averaged only in steps with
    its examples, the average of a rare robot would contain weights from before the learning rate fell.
    """
    decay = jnp.minimum(decay, warmup_decay(updates))

    def update(old: jax.Array, new: jax.Array) -> jax.Array:
        # The average of parameters that are never trained stays the same to the bit; the sum would be rounded.
        return jnp.where(old == new, old, decay * old + (1 - decay) * new)

    return jax.tree.map(update, ema, params)
