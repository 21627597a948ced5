"""Multi-head attention over one axis, with optional keys and values kept from earlier frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ExecutionConfig, ModelConfig
from hma_jax.kernels.attend import attend_all_within, attend_over_time, attend_within
from hma_jax.kernels.ops import contract, kept
from hma_jax.model.initial import trunk_init
from hma_jax.model.layers import LayerNorm
from hma_jax.model.params import bias, param

CACHED_BYTES = 2**20
"""What a frame's attention weights must exceed for `attend_within` to be worth it."""


def attention_scale(config: ModelConfig) -> float:
    """What multiplies q.k.

    Under muP attention_scale / head width: 8 / I as released, so that logits stay of order one
    as heads widen; otherwise 1 / sqrt(I).
    """
    if config.mup.enabled and "attention" not in config.mup.without:
        return config.mup.attention_scale / config.head_width
    return config.head_width**-0.5


class Attention(nnx.Module):
    """q, k, v and output projections; the caller says over which axis and what is visible."""

    def __init__(self, config: ModelConfig, execution: ExecutionConfig):
        width, heads, head = config.width, config.heads, config.head_width
        # The fans are those of the fused (3D, D) matrix of the release.
        init = trunk_init(config, width, 3 * width)
        self.qkv = param((width, 3, heads, head), ("D", None, "H", None), init, role="hidden")
        shape, axes = (3, heads, head), (None, "H", None)
        self.qkv_bias = bias(shape, axes) if config.qkv_bias else None
        init = trunk_init(config, width, width)
        self.out = param((heads, head, width), ("H", None, "D"), init, role="hidden")
        self.out_bias = bias((width,), ("D",)) if config.proj_bias else None
        self.norm = LayerNorm(head, axis=None) if config.qk_norm else None
        self.heads, self.scale = heads, attention_scale(config)
        self.by_frame = execution.attention != "plain"

    def project(self, x: jax.Array) -> jax.Array:
        """x [..., D] -> queries, keys and values [..., 3, H, I]."""
        qkv = contract(x, self.qkv.astype(x.dtype))
        if self.qkv_bias is not None:
            qkv = qkv + self.qkv_bias.astype(x.dtype)
        qkv = kept(qkv)
        if self.norm is None:
            return qkv
        return jnp.concatenate([self.norm(qkv[..., :2, :, :]), qkv[..., 2:, :, :]], axis=-3)

    def project_out(self, y: jax.Array) -> jax.Array:
        """y [..., H, I] -> [..., D]."""
        out = contract(y, self.out.astype(y.dtype), 2)
        return out if self.out_bias is None else out + self.out_bias.astype(y.dtype)

    def over_space(self, x_BTPD: jax.Array) -> jax.Array:
        """Every token sees every token of its own frame."""
        weights = x_BTPD.shape[2] ** 2 * self.heads * x_BTPD.dtype.itemsize
        by_frame = self.by_frame and weights > CACHED_BYTES
        attend = attend_within if by_frame else attend_all_within
        return self.project_out(attend(self.project(x_BTPD), self.scale))

    def over_time(
        self,
        x_BTPD: jax.Array,
        visible: jax.Array,
        past: tuple[jax.Array, jax.Array] | None,
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Every token sees its own position in other frames, where `visible` allows.

        `past` holds keys and values [B, T_past, P, H, I] of earlier frames. `visible` is
        bool [T, T_past + T]. Returns the output and the new frames' keys and values.
        """
        q, k, v = (part.squeeze(-3) for part in jnp.split(self.project(x_BTPD), 3, axis=-3))
        return self.project_out(attend_over_time(q, k, v, past, visible, self.scale)), (k, v)
