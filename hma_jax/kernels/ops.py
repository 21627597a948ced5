"""Functions of arrays whose gradients are written out, and what a backward pass keeps.

The gradients are the usual ones. They are written out where XLA on CPU is slow at those that
jax derives: it transposes the wider of two activations, and sums the product of two arrays many
times slower than it multiplies by a vector of ones.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

KEPT = "kept"


def kept(x: jax.Array) -> jax.Array:
    """x, marked to be kept for the backward pass of a block; what is not is computed again.

    Kept are products of matrices and what is dear to compute; norms, activations and the like
    take longer to store and read than to compute.
    """
    return checkpoint_name(x, KEPT)


def total(x: jax.Array, axis: int) -> jax.Array:
    """The sum over `axis`, -1 or -2, which stays with size 1."""
    ones = jnp.ones((x.shape[axis], 1), x.dtype)
    return jax.lax.platform_dependent(
        x,
        cpu=lambda x: x @ ones if axis == -1 else ones.T @ x,
        default=lambda x: jnp.sum(x, axis, keepdims=True),
    )


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def normalise(x: jax.Array, eps: float) -> jax.Array:
    """x with zero mean and unit variance over its last axis; statistics in float32."""
    return _normalise_forward(x, eps)[0]


def _normalise_forward(x: jax.Array, eps: float) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    x32 = x.astype(jnp.float32)
    centred = x32 - jnp.mean(x32, axis=-1, keepdims=True)
    scale = jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + eps)
    y32 = centred * scale
    return y32.astype(x.dtype), (y32, scale)


def _normalise_backward(eps: float, saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array]:
    y32, scale = saved
    g32, width = g.astype(jnp.float32), g.shape[-1]
    to_x = g32 - total(g32, -1) / width - y32 * (total(g32 * y32, -1) / width)
    return ((to_x * scale).astype(g.dtype),)


normalise.defvjp(_normalise_forward, _normalise_backward)


@jax.custom_jvp
def gelu(x: jax.Array) -> jax.Array:
    """The exact one: x times the normal distribution function of x, in float32."""
    return (x * _normal_below(x)).astype(x.dtype)


@gelu.defjvp
def _gelu_slope(x: tuple[jax.Array], tangent: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (t,) = x, tangent
    # Behind a barrier, or XLA computes erf once for value and slope, and stores it between them.
    x32 = jax.lax.optimization_barrier(x).astype(jnp.float32)
    slope = _normal_below(x32) + x32 * jnp.exp(-0.5 * jnp.square(x32)) / math.sqrt(2 * math.pi)
    return gelu(x), t * slope.astype(t.dtype)


def _normal_below(x: jax.Array) -> jax.Array:
    """By erf: jax.nn.gelu's erfc, exact in the far tail too, takes more than twice as long."""
    return 0.5 + 0.5 * jax.lax.erf(x.astype(jnp.float32) * math.sqrt(0.5))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def over_tokens(x_BTD: jax.Array, tokens: int) -> jax.Array:
    """[B, T, D] -> [B, T, P = tokens, D], the same on every token of a frame."""
    return jnp.broadcast_to(x_BTD[:, :, None], (*x_BTD.shape[:2], tokens, x_BTD.shape[2]))


def _over_tokens_backward(tokens: int, _: None, g: jax.Array) -> tuple[jax.Array]:
    return (total(g, -2).squeeze(-2),)


over_tokens.defvjp(lambda x, tokens: (over_tokens(x, tokens), None), _over_tokens_backward)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def contract(x: jax.Array, w: jax.Array, axes: int = 1) -> jax.Array:
    """x [..., in] times w [in, ...]; with `axes` 2 both have two axes for `in`."""
    return jnp.tensordot(x, w, axes)


def _contract_forward(x: jax.Array, w: jax.Array, axes: int) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return contract(x, w, axes), (x, w)


def _contract_backward(axes: int, saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, w = saved
    rows, outs = tuple(range(x.ndim - axes)), w.ndim - axes
    to_x = jnp.tensordot(g, w, (tuple(range(g.ndim - outs, g.ndim)), tuple(range(axes, w.ndim))))
    if math.prod(w.shape[:axes]) <= math.prod(w.shape[axes:]):
        return to_x, jnp.tensordot(x, g, (rows, rows))
    turned = jnp.tensordot(g, x, (rows, rows))
    return to_x, jnp.moveaxis(turned, tuple(range(outs)), tuple(range(axes, w.ndim)))


contract.defvjp(_contract_forward, _contract_backward)
