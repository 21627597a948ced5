"""The trunk: N spatio-temporal blocks, stacked on a layer axis and run by one scan."""

from __future__ import annotations

from typing import NamedTuple

import jax
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.model.actions import Modulation
from hma_jax.model.attention import Attention
from hma_jax.model.layers import LayerNorm, Linear
from hma_jax.params import stack
from hma_jax.sharding import constrain


class TemporalCache(NamedTuple):
    """Temporal keys and values of finished frames, each [N, B, T_past, P, H, I]."""

    keys: jax.Array
    values: jax.Array


class Block(nnx.Module):
    """Spatial attention, modulation by the action, causal temporal attention, MLP.

    The order is the release's (reference section 1.4). There is no norm before temporal
    attention: the released checkpoints were trained so.
    """

    def __init__(self, config: ModelConfig, embodiments: int):
        # With qk_norm the release drops both block norms (reference section 1.4).
        self.norm_space = None if config.qk_norm else LayerNorm(config.width)
        self.space = Attention(config)
        self.modulation = Modulation(config, embodiments)
        self.time = Attention(config)
        self.norm_mlp = None if config.qk_norm else LayerNorm(config.width)
        sizes = (config.width, config.mlp_width)
        options = {"gain": config.trunk_gain, "role": "hidden", "with_bias": config.mlp_bias}
        self.mlp_in = Linear(sizes, ("D", "F"), **options)
        self.mlp_out = Linear(sizes[::-1], ("F", "D"), **options)

    def __call__(
        self,
        x_BTPD: jax.Array,
        action_BTD: jax.Array | None,
        embodiment_B: jax.Array,
        visible: jax.Array,
        past: tuple[jax.Array, jax.Array] | None,
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        x = x_BTPD
        x = x + self.space.over_space(self.norm_space(x) if self.norm_space else x)
        if action_BTD is not None:
            x = x + self.modulation(x, action_BTD, embodiment_B)
        y, new = self.time.over_time(x, visible, past)
        x = x + y
        h = self.mlp_in(self.norm_mlp(x) if self.norm_mlp else x)
        x = x + self.mlp_out(jax.nn.gelu(h, approximate=False))
        return x, new


class Trunk(nnx.Module):
    """The part all robots share, but for the modulation slices inside its blocks."""

    def __init__(self, config: ModelConfig, embodiments: int):
        self.blocks = stack(lambda: Block(config, embodiments), config.layers)
        self.remat = config.remat

    def __call__(
        self,
        x_BTPD: jax.Array,
        action_BTD: jax.Array | None,
        embodiment_B: jax.Array,
        visible: jax.Array,
        past: TemporalCache | None = None,
        keep: bool = False,
    ) -> tuple[jax.Array, TemporalCache | None]:
        """Runs all blocks.

        `visible` [T, T_past + T] says which frames each frame's temporal attention may see.
        With `keep` the new frames' keys and values are returned for a cache.
        """
        block_def, layers = nnx.split(self.blocks)

        def body(x, xs):
            layer, layer_past = xs
            x, new = nnx.merge(block_def, layer)(x, action_BTD, embodiment_B, visible, layer_past)
            return constrain(x, ("B", None, None, "D_act")), new if keep else None

        if self.remat:
            body = jax.checkpoint(body, prevent_cse=False)
        x, new = jax.lax.scan(body, x_BTPD, (layers, past))
        return x, TemporalCache(*new) if keep else None
