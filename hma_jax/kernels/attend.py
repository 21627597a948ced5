"""Attention as functions of queries, keys and values."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from hma_jax.kernels.ops import kept, total
from hma_jax.runtime.sharding import is_split

FEW = 2
"""Frames up to here that attend to earlier ones do so one by one."""


def masked_softmax(logits: jax.Array, visible: jax.Array | None = None) -> jax.Array:
    """Softmax over the last axis in float32, over what is `visible` (which broadcasts)."""
    if visible is not None:
        logits = jnp.where(visible, logits, jnp.finfo(logits.dtype).min)
    return jax.nn.softmax(_float32(logits), axis=-1).astype(logits.dtype)


def attend_over_time(
    q: jax.Array,
    k: jax.Array,
    v: jax.Array,
    past: tuple[jax.Array, jax.Array] | None,
    visible: jax.Array,
    scale: float,
) -> jax.Array:
    """Attention of every position to itself in other frames, [B, T, P, H, I] each.

    `past` holds keys and values [B, T_past, P, H, I] of earlier frames. `visible` is bool
    [T, T_past + T].
    """
    if past is not None and q.shape[1] <= FEW:
        each = (_frame_over_time(q[:, t], (past[0], k), (past[1], v), visible[t], scale) for t in range(q.shape[1]))
        return jnp.stack(list(each), axis=1)
    if past is not None:
        k, v = (jnp.concatenate(both, axis=1) for both in zip(past, (k, v), strict=True))
    weights = kept(masked_softmax(scale * jnp.einsum("btphi,bsphi->bphts", q, k), visible))
    return kept(jnp.einsum("bphts,bsphi->btphi", weights, v))


def _frame_over_time(
    q: jax.Array, keys: tuple[jax.Array, ...], values: tuple[jax.Array, ...], visible: jax.Array, scale: float
) -> jax.Array:
    """q [B, P, H, I]: with a row per matrix, products and sums of arrays beat products of matrices.

    All in float32, as the sums inside a product of matrices are.
    """
    logits = jnp.concatenate([total(_float32(q)[:, None] * _float32(k), -1).squeeze(-1) for k in keys], axis=1)
    weights = masked_softmax(scale * jnp.moveaxis(logits, 1, -1), visible)
    frames = [_float32(v[:, t]) for v in values for t in range(v.shape[1])]
    return sum(weights[..., t, None] * frame for t, frame in enumerate(frames)).astype(q.dtype)


def _float32(x: jax.Array) -> jax.Array:
    return x.astype(jnp.float32)


def attend_all_within(qkv: jax.Array, scale: float) -> jax.Array:
    """Attention among the tokens of each frame, [B, T, P, 3, H, I] -> [B, T, P, H, I]; all weights at once."""
    q, k, v = (part.squeeze(3) for part in jnp.split(qkv, 3, axis=3))
    weights = masked_softmax(scale * jnp.einsum("btphi,btshi->bthps", q, k))
    return kept(jnp.einsum("bthps,btshi->btphi", weights, v))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def attend_within(qkv: jax.Array, scale: float) -> jax.Array:
    """The same; the weights are computed again in the backward pass, from the logarithm of their sum.

    On CPU one frame and head at a time, whose weights fit the cache, which all frames' together
    do not; on an accelerator, or where a mesh splits the batch or the heads, all at once.
    """
    return _every_head(partial(_head, scale), (2,), qkv)[0]


def _attend_within_forward(qkv: jax.Array, scale: float) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    y, log_sum = map(kept, _every_head(partial(_head, scale), (2,), qkv))
    return y, (qkv, y, log_sum)


def _attend_within_backward(scale: float, saved: tuple[jax.Array, ...], g: jax.Array) -> tuple[jax.Array]:
    qkv, y, log_sum = saved
    shared = total(_float32(g) * _float32(y), -1)
    return (_every_head(partial(_head_backward, scale), (2, 1, 1, 1), qkv, log_sum, shared, g),)


attend_within.defvjp(_attend_within_forward, _attend_within_backward)


def _head(scale: float, qkv: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[P, 3, I] -> what is attended to [P, I], and log sum exp of the logits [P, 1]."""
    logits, v = _logits(scale, qkv), qkv[:, 2]
    highest = jnp.max(logits, -1, keepdims=True)
    weights = jnp.exp(logits - highest)
    summed = jnp.sum(weights, -1, keepdims=True)
    return ((weights.astype(v.dtype) @ v) / summed).astype(v.dtype), highest + jnp.log(summed)


def _head_backward(
    scale: float, qkv: jax.Array, log_sum: jax.Array, shared: jax.Array, g: jax.Array
) -> jax.Array:
    """The gradient [P, 3, I]. `shared` [P, 1] is g.y, the mean over what is seen of the weights' gradient."""
    q, k, v = qkv[:, 0], qkv[:, 1], qkv[:, 2]
    weights = jnp.exp(_logits(scale, qkv) - log_sum)
    to_logits = (scale * weights * (_float32(g @ v.T) - shared)).astype(q.dtype)
    return jnp.stack([to_logits @ k, to_logits.T @ q, weights.astype(g.dtype).T @ g], axis=1)


def _logits(scale: float, qkv: jax.Array) -> jax.Array:
    return scale * _float32(qkv[:, 0] @ qkv[:, 1].T)


def _every_head(head: Callable, axes: tuple[int, ...], *args: jax.Array):
    """`head` over arrays [B, T, P, ...] whose axis of heads in a frame is in `axes`.

    It sees and gives what is left of a frame without that axis.
    """

    def frame(*args: jax.Array):
        """Separate products of matrices run side by side on CPU; a batched one does not."""
        heads = [
            head(*(jax.lax.index_in_dim(x, h, axis, keepdims=False) for x, axis in zip(args, axes, strict=True)))
            for h in range(args[0].shape[axes[0]])
        ]
        return jax.tree.map(lambda *y: jnp.stack(y, axis=y[0].ndim - 1), *heads)

    def one_by_one(*args: jax.Array):
        shape = args[0].shape[:2]
        rows = tuple(x.reshape(-1, *x.shape[2:]) for x in args)
        out = jax.lax.map(lambda row: frame(*row), rows)
        return jax.tree.map(lambda y: y.reshape(*shape, *y.shape[1:]), out)

    all_at_once = jax.vmap(jax.vmap(lambda *args: jax.vmap(head, in_axes=axes, out_axes=-2)(*args)))
    if is_split():
        return all_at_once(*args)
    return jax.lax.platform_dependent(*args, cpu=one_by_one, default=all_at_once)
