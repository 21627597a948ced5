"""Attention as its formula says, for XLA to compile: the reference of every other backend."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.kernels import remat

MASKED_LOGIT = -1e30
"""The logit of masked keys; finite, so that a row without a visible key gives no NaN."""


def softmax(logits: jax.Array, visible: jax.Array | None = None) -> jax.Array:
    """float32 softmax over the last axis, over what is `visible` (bool, which broadcasts)."""
    if visible is not None:
        logits = jnp.where(visible, logits, MASKED_LOGIT)
    return jax.nn.softmax(logits, axis=-1)


def within(qkv: jax.Array, scale: float) -> jax.Array:
    q, k, v = split(qkv)
    logits = jnp.einsum("btphi,btshi->bthps", q, k, preferred_element_type=jnp.float32)
    weights = _kept_if_small(softmax(scale * logits).astype(v.dtype), qkv)
    return remat.tag_costly(jnp.einsum("bthps,btshi->btphi", weights, v))


def over_time(qkv: jax.Array, visible: jax.Array, scale: float) -> jax.Array:
    q, k, v = split(qkv)
    weights = _kept_if_small(_weights(q, k, visible, scale).astype(v.dtype), qkv)
    return remat.tag_costly(jnp.einsum("bphts,bsphi->btphi", weights, v))


def over_cache(qkv: jax.Array, keys: jax.Array, values: jax.Array, visible: jax.Array, scale: float) -> jax.Array:
    q, k, v = split(qkv)
    k, v = jnp.concatenate([keys, k], axis=1), jnp.concatenate([values, v], axis=1)
    weights = _weights(q, k, visible, scale).astype(v.dtype)
    return jnp.einsum("bphts,bsphi->btphi", weights, v)


def _weights(q: jax.Array, k: jax.Array, visible: jax.Array, scale: float) -> jax.Array:
    """Attention weights between every position's frames, float32 [B, P, H, T, T_past + T]."""
    logits = jnp.einsum("btphi,bsphi->bphts", q, k, preferred_element_type=jnp.float32)
    return softmax(scale * logits, visible if visible.ndim == 2 else visible[:, None, None])


def _kept_if_small(weights: jax.Array, qkv: jax.Array) -> jax.Array:
    """Marks attention weights as worth saving for the backward pass if they are smaller than q, k and v."""
    return remat.tag_product(weights) if weights.size <= qkv.size else weights


def split(qkv: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Queries, keys and values [..., H, I] of [..., 3, H, I]."""
    return qkv[..., 0, :, :], qkv[..., 1, :, :], qkv[..., 2, :, :]
