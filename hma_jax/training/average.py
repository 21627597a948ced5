"""An exponential moving average of the weights: smoother than the last ones, for inference."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.model.params import Params


def warmup_decay(updates: int | jax.Array) -> float | jax.Array:
    """Upper bound on the decay after n `updates`, int []: (1 + n) / (10 + n), the warm-up of TensorFlow's
    ExponentialMovingAverage(num_updates=n)."""
    return (1 + updates) / (10 + updates)


def update_average(ema: Params, params: Params, decay: float, updates: jax.Array) -> Params:
    """d * ema + (1 - d) * params, for all robots, those without an example too, whose parameters stand still.

    The average starts as a copy of the initial parameters. So that it is soon free of them, d rises to `decay` with the
    number of `updates` before this one, int [] (`warmup_decay`): by `decay` alone the average of a
    short run would be in large part of weights that nothing has trained. All of it is of the same steps: were a robot's
    only of those that had examples of it, a rare robot's would be of weights from before the learning rate fell.
    """
    decay = jnp.minimum(decay, warmup_decay(updates))

    def update(old: jax.Array, new: jax.Array) -> jax.Array:
        # The average of what is never trained stays the same to the bit, where the sum would be rounded.
        return jnp.where(old == new, old, decay * old + (1 - decay) * new)

    return jax.tree.map(update, ema, params)
