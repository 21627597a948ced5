"""An exponential moving average of the weights: smoother than the last ones, for inference."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.model.params import Params, ParamSpec, is_spec
from hma_jax.training.optimizer import Presence


def update_average(ema: Params, params: Params, specs: Params, presence: Presence, decay: float) -> Params:
    """decay * ema + (1 - decay) * params, for the parameters that the step updates (`Presence`).

    The average starts as a copy of the initial parameters. A robot without an example keeps its average as it keeps its
    parameters: its average is over the steps that had examples of it.
    """

    def update(spec: ParamSpec, old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(presence.of(spec), decay * old + (1 - decay) * new, old)

    return jax.tree.map(update, specs, ema, params, is_leaf=is_spec)
