"""The stems: they map every robot's action chunks to features of the trunk's width.

Reference section 1.3. What the trunk does with a feature is in `conditioning`. The paper's text
gives one Xavier gain, 0.1, for "action projectors"; the release uses 0.1 for the modulation and 0.01 for the stems
(reference section 1.10).
"""

from __future__ import annotations

import jax
import numpy as np
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.kernels.pointwise import layer_norm, scaled, shifted
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.initial import hidden_init, input_fan_out
from hma_jax.model.layers import BLOCK_EPS, EmbodimentLinear, robot_vectors
from hma_jax.model.params import bias, ones, param, uniform


class Stem(nnx.Module):
    """Normalised action chunks of any robot to features: Linear, layer norm, ReLU, Linear."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable):
        size, width = table.size, config.width

        def first_layer(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
            # Each robot's slice has the fan-in of its own chunk. Rows of padding are zero and
            # stay so, because padded inputs are zero.
            chunk_E = table.chunks[:, None, None]
            own = np.arange(shape[1])[:, None] < chunk_E
            bound = config.stem_gain * np.sqrt(6 / (chunk_E + input_fan_out(config)))
            return uniform(rng, shape, np.where(own, bound, 0.0))

        self.into = EmbodimentLinear(size, (table.action_width, width), ("U", "D"), init=first_layer, role="input")
        self.gain = param((size, width), ("E", "D"), ones, role="vector")
        self.bias = bias((size, width), ("E", "D"))
        init = hidden_init(config, width, width, config.stem_gain)
        self.out = EmbodimentLinear(size, (width, width), ("D", "D_out"), init=init, role="hidden")

    def __call__(self, actions_BTU: jax.Array, robot_row_B: jax.Array) -> jax.Array:
        """Normalised, zero-padded actions -> features a_BTD in their type."""
        x = layer_norm(self.into(actions_BTU, robot_row_B), BLOCK_EPS)
        x = shifted(scaled(x, robot_vectors(self.gain, robot_row_B, x)), robot_vectors(self.bias, robot_row_B, x))
        return self.out(jax.nn.relu(x), robot_row_B)
