"""The trunk: N spatio-temporal blocks, stacked on a layer axis and run by one scan."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
from flax import nnx

from hma_jax.config import ExecutionConfig, ModelConfig
from hma_jax.kernels import remat
from hma_jax.kernels.pointwise import gelu
from hma_jax.model.attention import Attention, Past
from hma_jax.model.conditioning import ActionFeature, make_conditioning
from hma_jax.model.initial import trunk_init
from hma_jax.model.layers import LayerNorm, Linear
from hma_jax.model.params import layer_for_compute, stack
from hma_jax.runtime.sharding import constrain

MAX_UNROLLED_LAYERS = 4
"""Trunks with at most this many layers are unrolled: without slicing stacked arrays, steps of small models are a
seventh faster on CPU, and so few layers compile as fast. At width 256 nothing is gained: four layers take 4.45 s a step
unrolled and 4.20 s scanned."""


class TemporalCache(NamedTuple):
    """Keys and values of finished frames, for later ones to attend to; every array is [N, B, T_past, ...]."""

    time: Past  # of temporal attention [N, B, T_past, P, H, I]
    actions: Any  # keys, values and shown of cross-attention to actions; otherwise None


class Block(nnx.Module):
    """Spatial attention, conditioning on the action, temporal attention, MLP.

    The order is the release's (reference section 1.4). There is no norm before temporal
    attention: the released checkpoints were trained that way. DIFFERS: the MLP has no dropout; the release's continuous
    configurations train with 0.05.
    """

    def __init__(self, config: ModelConfig, embodiments: int, execution: ExecutionConfig):
        # With qk_norm the release drops both block norms (reference section 1.4).
        self.norm_space = None if config.qk_norm else LayerNorm(config.width)
        self.space = Attention(config, execution)
        self.conditioning = make_conditioning(config, embodiments)
        self.time = Attention(config, execution)
        self.norm_mlp = None if config.qk_norm else LayerNorm(config.width)
        sizes = (config.width, config.mlp_width)
        options = {"init": trunk_init(config, *sizes), "role": "hidden", "with_bias": config.mlp_bias}
        self.mlp_in = Linear(sizes, ("D", "F"), **options)
        self.mlp_out = Linear(sizes[::-1], ("F", "D"), **options)

    def __call__(
        self,
        x_BTPD: jax.Array,
        action: ActionFeature | None,
        robot_row_B: jax.Array,
        visible: jax.Array,
        past: TemporalCache | None,
    ) -> tuple[jax.Array, TemporalCache]:
        """`past` and what is returned are this layer's part of the cache."""
        past_time, past_actions = past or (None, None)
        x, new_actions = x_BTPD, None
        x = remat.tag_product(_by_example(x + self.space.over_space(self.norm_space(x) if self.norm_space else x)))
        if action is not None and self.conditioning is not None:
            y, new_actions = self.conditioning(x, action, robot_row_B, visible, past_actions)
            x = remat.tag_product(_by_example(x + y))
        y, new_time = self.time.over_time(x, visible, past_time)
        x = remat.tag_product(_by_example(x + y))
        h = remat.tag_costly(self.mlp_in(self.norm_mlp(x) if self.norm_mlp else x))
        x = x + self.mlp_out(gelu(h))
        return x, TemporalCache(new_time, new_actions)


class Trunk(nnx.Module):
    """The part that all robots share, except for the conditioning inside its blocks."""

    def __init__(self, config: ModelConfig, embodiments: int, execution: ExecutionConfig):
        self.blocks = stack(lambda: Block(config, embodiments, execution), config.layers)
        self.remat = execution.remat
        self.unroll = config.layers if config.layers <= MAX_UNROLLED_LAYERS else 1

    def __call__(
        self,
        x_BTPD: jax.Array,
        action: ActionFeature | None,
        robot_row_B: jax.Array,
        visible: jax.Array,
        past: TemporalCache | None = None,
        cache_frames: int = 0,
    ) -> tuple[jax.Array, TemporalCache | None]:
        """Runs all blocks.

        `visible` [T, T_past + T]: the frames that each frame's temporal attention may see. The cache of the first
        `cache_frames` new frames is returned; None if `cache_frames` is 0.
        """
        block_def, layers = nnx.split(self.blocks)

        def body(x, xs):
            layer, layer_past = xs
            x = remat.tag_block_input(x)
            layer = layer_for_compute(layer, x.dtype)
            x, new = nnx.merge(block_def, layer)(x, action, robot_row_B, visible, layer_past)
            new = jax.tree.map(lambda y: y[:, :cache_frames], new) if cache_frames else None
            return _by_example(x), new

        body = remat.checkpointed(body, self.remat, scanned=self.unroll == 1)
        return jax.lax.scan(body, x_BTPD, (layers, past), unroll=self.unroll)


def _by_example(x_BTPD: jax.Array) -> jax.Array:
    """Fixes the layout of activations: every device holds whole examples.

    It is called after every sum, not only after every block: otherwise XLA (jax 0.10) chooses other layouts for passes
    over one frame on a mesh with data, fsdp and tensor all above 1, and then computes wrong numbers.
    """
    return constrain(x_BTPD, ("B", None, None, "D_act"))
