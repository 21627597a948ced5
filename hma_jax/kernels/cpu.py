"""Attention for CPUs: the attention weights of one frame at a time. They fit in the processor's cache; those of all
frames together do not.

The backward pass recomputes a frame's weights from the log-sum-exp of its logits. Heads are split into a few groups of
independent operations: XLA's thread pool runs those in parallel, but not the matrices of one batched product. With a
single query per position, as in generation, element-wise products and sums are faster than matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from hma_jax.kernels import plain, remat
from hma_jax.kernels.pointwise import sum_over
from hma_jax.runtime.sharding import is_split

CACHED_BYTES = 2**20
"""Frames with attention weights of at most this size are left to `plain`: they stay in the cache anyway."""

HEAD_GROUPS = 2
"""Groups of heads that are computed in parallel. Measured on two cores: a single group used only one of them."""

MAX_SINGLE_FRAMES = 2
"""With at most this many frames, each attends to the cache on its own."""


def within(qkv: jax.Array, scale: float) -> jax.Array:
    """As `plain.within`, to which small frames and arrays split over a mesh are left."""
    frame = qkv.shape[2] ** 2 * qkv.shape[4] * 4
    if frame <= CACHED_BYTES or is_split():
        return plain.within(qkv, scale)
    return _by_frame(qkv, scale)


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def _by_frame(qkv: jax.Array, scale: float) -> jax.Array:
    return _forward(qkv, scale)[0]


def _forward(qkv: jax.Array, scale: float) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    frames = qkv.reshape(-1, *qkv.shape[2:])
    y, log_sum = jax.lax.map(partial(_in_head_groups, partial(_attend, scale)), (frames,))
    y, log_sum = remat.tag_costly(y.reshape(*qkv.shape[:3], *qkv.shape[4:])), remat.tag_costly(log_sum)
    return y, (qkv, y, log_sum)


def _backward(scale: float, saved: tuple[jax.Array, ...], dy: jax.Array) -> tuple[jax.Array]:
    qkv, y, log_sum = saved
    # For each row, the mean of dweights under the attention weights, which equals dy.y.
    delta = jnp.swapaxes(sum_over(dy.astype(jnp.float32) * y.astype(jnp.float32), -1)[..., 0], -1, -2)
    frames, dy, delta = (x.reshape(-1, *x.shape[2:]) for x in (qkv, dy, delta))
    dqkv = jax.lax.map(partial(_in_head_groups, partial(_attend_backward, scale)), (frames, dy, log_sum, delta))
    return (dqkv.reshape(qkv.shape),)


_by_frame.defvjp(_forward, _backward)


def _in_head_groups(attend: Callable, frame: tuple[jax.Array, ...]):
    """Applies `attend` to groups of heads. Arrays [P, ..., H, I] are passed as [H, ..., P, I], arrays [H, P] as they
    are; results are returned in the original layout."""
    heads = frame[0].shape[-2]
    size = -(-heads // HEAD_GROUPS)
    by_head = [x if x.ndim == 2 else jnp.moveaxis(x, (-2, 0), (0, -2)) for x in frame]
    groups = [attend(*(x[first : first + size] for x in by_head)) for first in range(0, heads, size)]
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts), *groups)
    return jax.tree.map(lambda x: x if x.ndim == 2 else jnp.moveaxis(x, (0, -2), (-2, 0)), joined)


def _attend(scale: float, qkv: jax.Array) -> tuple[jax.Array, jax.Array]:
    """qkv [H, 3, P, I] -> the output of attention [H, P, I], and the log-sum-exp of the logits [H, P]."""
    q, k, v = qkv[:, 0], qkv[:, 1], qkv[:, 2]
    logits = scale * jnp.einsum("hpi,hsi->hps", q, k, preferred_element_type=jnp.float32)
    highest = jnp.max(logits, axis=-1, keepdims=True)
    weights = jnp.exp(logits - highest)
    total = jnp.sum(weights, axis=-1, keepdims=True)
    y = jnp.einsum("hps,hsi->hpi", weights.astype(v.dtype), v) / total
    return y.astype(v.dtype), (highest + jnp.log(total))[..., 0]


def _attend_backward(scale: float, qkv: jax.Array, dy: jax.Array, log_sum: jax.Array, delta: jax.Array) -> jax.Array:
    """dqkv [H, 3, P, I]. Rows of the weights are keys here, so that only one of the three products has a transposed
    factor."""
    q, k, v = qkv[:, 0], qkv[:, 1], qkv[:, 2]
    logits = scale * jnp.einsum("hsi,hpi->hsp", k, q, preferred_element_type=jnp.float32)
    weights = jnp.exp(logits - log_sum[:, None])
    dweights = jnp.einsum("hsi,hpi->hsp", v, dy, preferred_element_type=jnp.float32)
    dlogits = (scale * weights * (dweights - delta[:, None])).astype(q.dtype)
    dq = jnp.einsum("hsp,hsi->hpi", dlogits, k)
    dk = jnp.einsum("hsp,hpi->hsi", dlogits, q)
    dv = jnp.einsum("hsp,hpi->hsi", weights.astype(dy.dtype), dy)
    return jnp.stack([dq, dk, dv], axis=1)


def over_cache(qkv: jax.Array, keys: jax.Array, values: jax.Array, visible: jax.Array, scale: float) -> jax.Array:
    """As `plain.over_cache`."""
    if qkv.shape[1] > MAX_SINGLE_FRAMES:
        return plain.over_cache(qkv, keys, values, visible, scale)
    q, k, v = plain.split(qkv)
    each = [_one_frame(q[:, t], (keys, k), (values, v), visible[t], scale) for t in range(qkv.shape[1])]
    return jnp.stack(each, axis=1)


def _one_frame(
    q: jax.Array, keys: tuple[jax.Array, ...], values: tuple[jax.Array, ...], visible: jax.Array, scale: float
) -> jax.Array:
    """q [B, P, H, I] attends to frames [B, T, P, H, I] that are given in several arrays. These are not concatenated, so
    the cache is not copied.

    Sums are in float32, like those inside a matrix product.
    """
    q32 = q.astype(jnp.float32)[:, None]
    logits = jnp.concatenate([sum_over(q32 * k.astype(jnp.float32), -1)[..., 0] for k in keys], axis=1)
    weights = plain.softmax(scale * jnp.moveaxis(logits, 1, -1), visible)
    frames = [v[:, t].astype(jnp.float32) for v in values for t in range(v.shape[1])]
    return sum(weights[..., t, None] * frame for t, frame in enumerate(frames)).astype(q.dtype)
