"""Multi-head attention of a frame's tokens to each other, and of a position to itself over time."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ExecutionConfig, ModelConfig
from hma_jax.kernels import remat
from hma_jax.kernels.attention import find_backend
from hma_jax.kernels.dense import contract
from hma_jax.kernels.pointwise import shifted
from hma_jax.model.initial import trunk_init
from hma_jax.model.layers import LayerNorm
from hma_jax.model.params import bias, param


class Past(NamedTuple):
    """Keys and values of earlier frames, [B, T_past, P, H, I] each."""

    keys: jax.Array
    values: jax.Array


def attention_scale(config: ModelConfig) -> float:
    """The factor on q.k.

    Under muP it is attention_scale / I (8 / I as released), so that logits stay of order one as heads widen. Otherwise
    it is 1 / sqrt(I).
    """
    if config.mup.enabled and "attention" not in config.mup.without:
        return config.mup.attention_scale / config.head_width
    return config.head_width**-0.5


class Attention(nnx.Module):
    """q, k, v and output projections; the caller chooses the axis of attention and what is visible."""

    def __init__(self, config: ModelConfig, execution: ExecutionConfig):
        width, heads, head = config.width, config.heads, config.head_width
        # The fans are those of the fused (3D, D) matrix of the release.
        init = trunk_init(config, width, 3 * width)
        shape, axes = (width, 3, heads, head), ("D", None, "H", None)
        self.qkv = param(shape, axes, init, role="hidden", matrix=((-4,), (-2, -1)))
        shape, axes = (3, heads, head), (None, "H", None)
        self.qkv_bias = bias(shape, axes) if config.qkv_bias else None
        init = trunk_init(config, width, width)
        shape, axes = (heads, head, width), ("H", None, "D")
        self.out = param(shape, axes, init, role="hidden", matrix=((-3, -2), (-1,)))
        self.out_bias = bias((width,), ("D",)) if config.proj_bias else None
        self.norm = LayerNorm(head, axis=None) if config.qk_norm else None
        self.scale, self.backend = attention_scale(config), execution.attention

    def project(self, x: jax.Array) -> jax.Array:
        """x [..., D] -> queries, keys and values [..., 3, H, I]."""
        qkv = contract(x, self.qkv.astype(x.dtype))
        if self.qkv_bias is not None:
            qkv = shifted(qkv, self.qkv_bias.get_value())
        qkv = remat.tag_product(qkv)
        if self.norm is None:
            return qkv
        return jnp.concatenate([self.norm(qkv[..., :2, :, :]), qkv[..., 2:, :, :]], axis=-3)

    def project_out(self, y: jax.Array) -> jax.Array:
        """y [..., H, I] -> [..., D]."""
        out = contract(y, self.out.astype(y.dtype), 2)
        return out if self.out_bias is None else shifted(out, self.out_bias.get_value())

    def over_space(self, x_BTPD: jax.Array) -> jax.Array:
        """Every token sees every token of its own frame."""
        return self.project_out(find_backend(self.backend).within(self.project(x_BTPD), self.scale))

    def over_time(self, x_BTPD: jax.Array, visible: jax.Array, past: Past | None) -> tuple[jax.Array, Past]:
        """Every token sees the token at its own position in each frame that `visible`, bool [T, T_past + T], allows.

        Returns the output and the new frames' keys and values.
        """
        qkv, kernels = self.project(x_BTPD), find_backend(self.backend)
        if past is None:
            y = kernels.over_time(qkv, visible, self.scale)
        else:
            y = kernels.over_cache(qkv, past.keys, past.values, visible, self.scale)
        return self.project_out(y), Past(qkv[..., 1, :, :], qkv[..., 2, :, :])
