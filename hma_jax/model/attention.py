"""Multi-head attention over one axis, with optional keys and values kept from earlier frames."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.model.initial import trunk_init
from hma_jax.model.layers import LayerNorm, contract
from hma_jax.params import bias, param
from hma_jax.sharding import is_split

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

    def __init__(self, config: ModelConfig):
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
        self.scale = attention_scale(config)
        self.by_frame = config.attention == "by_frame"

    def project(self, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """x [..., D] -> q, k, v [..., H, I]; q carries the scale."""
        qkv = contract(x, self.qkv.astype(x.dtype))
        if self.qkv_bias is not None:
            qkv = qkv + self.qkv_bias.astype(x.dtype)
        q, k, v = (part.squeeze(-3) for part in jnp.split(qkv, 3, axis=-3))
        if self.norm is not None:
            q, k = self.norm(q), self.norm(k)
        return q * self.scale, k, v

    def project_out(self, y: jax.Array) -> jax.Array:
        """y [..., H, I] -> [..., D]."""
        out = contract(y, self.out.astype(y.dtype), 2)
        return out if self.out_bias is None else out + self.out_bias.astype(y.dtype)

    def over_space(self, x_BTPD: jax.Array) -> jax.Array:
        """Every token sees every token of its own frame."""
        q, k, v = self.project(x_BTPD)
        weights = x_BTPD.shape[2] ** 2 * q.shape[-2] * q.dtype.itemsize
        by_frame = self.by_frame and weights > CACHED_BYTES
        return self.project_out((attend_within if by_frame else _all_frames)(q, k, v))

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
        q, k, v = self.project(x_BTPD)
        new = (k, v)
        if past is not None:
            k = jnp.concatenate([past[0], k], axis=1)
            v = jnp.concatenate([past[1], v], axis=1)
        logits = jnp.einsum("btphi,bsphi->bphts", q, k)
        weights = masked_softmax(logits, visible)
        if past is None or x_BTPD.shape[1] > 2:
            y = jnp.einsum("bphts,bsphi->btphi", weights, v)
        else:  # XLA on CPU is several times faster at one frame's weighted sum than at two frames'
            frames = (weights[..., t, :] for t in range(x_BTPD.shape[1]))
            y = jnp.stack([jnp.einsum("bphs,bsphi->bphi", w, v) for w in frames], axis=1)
        return self.project_out(y), new


def masked_softmax(logits: jax.Array, visible: jax.Array | None = None) -> jax.Array:
    """Softmax over the last axis in float32, over what is `visible` (which broadcasts)."""
    if visible is not None:
        logits = jnp.where(visible, logits, jnp.finfo(logits.dtype).min)
    return jax.nn.softmax(logits.astype(jnp.float32), axis=-1).astype(logits.dtype)


@jax.custom_vjp
def attend_within(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    """Attention among the tokens of each frame, [B, T, P, H, I] each; the weights are computed
    again in the backward pass.

    On CPU one frame and head at a time, whose weights fit the cache, which all frames' together
    do not; on an accelerator, or where a mesh splits the batch or the heads, all at once.
    """
    return _per_platform(_one_frame, _all_frames)(q, k, v)


def _attend_within_forward(q: jax.Array, k: jax.Array, v: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    return attend_within(q, k, v), (q, k, v)


def _attend_within_backward(kept: tuple[jax.Array, ...], g: jax.Array) -> tuple[jax.Array, ...]:
    def gradient_of(attend: Callable) -> Callable:
        return lambda q, k, v, g: jax.vjp(attend, q, k, v)[1](g)

    return _per_platform(gradient_of(_one_frame), gradient_of(_all_frames))(*kept, g)


attend_within.defvjp(_attend_within_forward, _attend_within_backward)


def _per_platform(one_frame: Callable, all_frames: Callable) -> Callable:
    """`all_frames` of [B, T, ...], but on CPU `one_frame` of [...] over and over."""
    if is_split():
        return all_frames

    def frame_by_frame(*args: jax.Array):
        shape = args[0].shape[:2]
        rows = tuple(x.reshape(-1, *x.shape[2:]) for x in args)
        out = jax.lax.map(lambda frame: one_frame(*frame), rows)
        return jax.tree.map(lambda y: y.reshape(*shape, *y.shape[1:]), out)

    return lambda *args: jax.lax.platform_dependent(*args, cpu=frame_by_frame, default=all_frames)


def _all_frames(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    weights = masked_softmax(jnp.einsum("btphi,btshi->bthps", q, k))
    return jnp.einsum("bthps,btshi->btphi", weights, v)


def _one_frame(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    """[P, H, I] each. Separate products of matrices run side by side; a batched one does not."""
    heads = [masked_softmax(q[:, h] @ k[:, h].T) @ v[:, h] for h in range(q.shape[1])]
    return jnp.stack(heads, axis=1)
