"""How actions enter: the per-robot stem, and the per-robot modulation inside every block.

`concat+modulate` of the release (reference sections 1.3 and 1.6): the stem's feature is
appended to each frame as K identical tokens, and it also shifts and scales every token
between spatial and temporal attention. The paper's text gives one Xavier gain, 0.1, for "action
projectors"; the release has it for the modulation and 0.01 for the stems (section 1.10).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.embodiments import EmbodimentTable
from hma_jax.model.layers import BLOCK_EPS, MODULATION_EPS, EmbodimentLinear, normalise
from hma_jax.params import bias, ones, param, uniform, xavier_uniform


class Stem(nnx.Module):
    """Raw action chunks of any robot to features: Linear, layer norm, ReLU, Linear."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable):
        size, width = table.size, config.width
        self.table = table

        def first_layer(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
            # Each robot's slice has the fan-in of its own chunk. Rows of padding are zero and
            # stay so, because padded inputs are zero.
            chunk_E = np.array([entry.chunk for entry in table.entries])[:, None, None]
            own = np.arange(shape[1])[:, None] < chunk_E
            return uniform(rng, shape, np.where(own, config.stem_gain * np.sqrt(6 / (chunk_E + width)), 0.0))

        self.into = EmbodimentLinear(
            size, (table.action_width, width), ("U", "D"), init=first_layer, role="input"
        )
        self.gain = param((size, width), ("E", "D"), ones, role="vector")
        self.bias = bias((size, width), ("E", "D"))
        init = xavier_uniform(width, width, config.stem_gain)
        self.out = EmbodimentLinear(size, (width, width), ("D", "D_out"), init=init, role="hidden")

    def __call__(self, actions_BTU: jax.Array, embodiment_B: jax.Array, dtype: jnp.dtype) -> jax.Array:
        """Raw, zero-padded actions -> features a_BTD in `dtype`."""
        mean_EU, inverse_EU = self.table.normaliser()
        mean_BU, inverse_BU = jnp.take(mean_EU, embodiment_B, 0), jnp.take(inverse_EU, embodiment_B, 0)
        x = ((actions_BTU - mean_BU[:, None]) * inverse_BU[:, None]).astype(dtype)
        x = normalise(self.into(x, embodiment_B), BLOCK_EPS)
        gain = jnp.take(self.gain.get_value(), embodiment_B, 0)[:, None].astype(dtype)
        offset = jnp.take(self.bias.get_value(), embodiment_B, 0)[:, None].astype(dtype)
        return self.out(jax.nn.relu(x * gain + offset), embodiment_B)


class Modulation(nnx.Module):
    """x -> W_o[LN(x) (1 + scale) + shift] with (shift, scale) from the action feature."""

    def __init__(self, config: ModelConfig, embodiments: int):
        width = config.width
        init = xavier_uniform(width, width, config.trunk_gain)
        wide = xavier_uniform(width, 2 * width, config.trunk_gain)
        square, double = (width, width), (width, 2 * width)
        axes = ("D", "D_out")
        self.hidden = EmbodimentLinear(embodiments, square, axes, init=init, role="hidden")
        self.shift_scale = EmbodimentLinear(embodiments, double, axes, init=wide, role="hidden")
        self.out = EmbodimentLinear(embodiments, square, axes, init=init, role="hidden")

    def __call__(self, x_BTPD: jax.Array, action_BTD: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        both = self.shift_scale(jax.nn.silu(self.hidden(action_BTD, embodiment_B)), embodiment_B)
        shift, scale = jnp.split(both[:, :, None], 2, axis=-1)
        return self.out(normalise(x_BTPD, MODULATION_EPS) * (1 + scale) + shift, embodiment_B)
