"""Layer norm, GELU, and biases and gains broadcast over rows, with their gradients.

The gradients are the usual ones. They are written out so that a backward pass saves no more than it needs, and to avoid
sums over the last axis of a product of two arrays, which XLA computes many times slower on CPUs than a product with a
vector of ones. The gradient of a vector that all rows share is summed in float32 whatever the type of the rows: in
bfloat16 a sum of thousands of terms would stop growing at a few hundred.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp


def sum_over(x: jax.Array, axis: int) -> jax.Array:
    """The sum over `axis`, -1 or -2, which stays with size 1."""
    ones = jnp.ones((x.shape[axis], 1), x.dtype)
    return jax.lax.platform_dependent(
        x,
        cpu=lambda x: x @ ones if axis == -1 else ones.T @ x,
        default=lambda x: jnp.sum(x, axis, keepdims=True),
    )


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def layer_norm(x: jax.Array, eps: float) -> jax.Array:
    """x with zero mean and unit variance over its last axis; statistics in float32."""
    return _layer_norm_forward(x, eps)[0]


def _layer_norm_forward(x: jax.Array, eps: float) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    x32 = x.astype(jnp.float32)
    centred = x32 - jnp.mean(x32, axis=-1, keepdims=True)
    scale = jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + eps)
    y32 = centred * scale
    return y32.astype(x.dtype), (y32, scale)


def _layer_norm_backward(eps: float, saved: tuple[jax.Array, jax.Array], dy: jax.Array) -> tuple[jax.Array]:
    y32, scale = saved
    dy32, width = dy.astype(jnp.float32), dy.shape[-1]
    dx = dy32 - sum_over(dy32, -1) / width - y32 * (sum_over(dy32 * y32, -1) / width)
    return ((dx * scale).astype(dy.dtype),)


layer_norm.defvjp(_layer_norm_forward, _layer_norm_backward)


@jax.custom_jvp
def gelu(x: jax.Array) -> jax.Array:
    """The exact GELU: x times the standard normal CDF at x, in float32."""
    return (x * _normal_cdf(x)).astype(x.dtype)


@gelu.defjvp
def _gelu_slope(x: tuple[jax.Array], tangent: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (t,) = x, tangent
    # Without the barrier XLA computes erf once for value and slope, and stores it in between, which is slower on CPU.
    x32 = jax.lax.platform_dependent(x, cpu=jax.lax.optimization_barrier, default=lambda x: x).astype(jnp.float32)
    slope = _normal_cdf(x32) + x32 * jnp.exp(-0.5 * jnp.square(x32)) / math.sqrt(2 * math.pi)
    return gelu(x), t * slope.astype(t.dtype)


def _normal_cdf(x: jax.Array) -> jax.Array:
    """The standard normal CDF, computed with erf. The erfc in jax.nn.gelu is also accurate in the far tail, but takes
    more than twice as long."""
    return 0.5 + 0.5 * jax.lax.erf(x.astype(jnp.float32) * math.sqrt(0.5))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def over_tokens(x_BTD: jax.Array, tokens: int) -> jax.Array:
    """[B, T, D] -> [B, T, P = tokens, D], the same on every token of a frame."""
    return jnp.broadcast_to(x_BTD[:, :, None], (*x_BTD.shape[:2], tokens, x_BTD.shape[2]))


def _over_tokens_backward(tokens: int, _: None, dy: jax.Array) -> tuple[jax.Array]:
    return (sum_over(dy, -2).squeeze(-2),)


over_tokens.defvjp(lambda x, tokens: (over_tokens(x, tokens), None), _over_tokens_backward)


# --- Vectors that rows share -----------------------------------------------------------------------


@jax.custom_vjp
def shifted(x: jax.Array, shift: jax.Array) -> jax.Array:
    """x + shift in the type of x; `shift` broadcasts."""
    return x + shift.astype(x.dtype)


shifted.defvjp(lambda x, shift: (shifted(x, shift), shift), lambda shift, dy: (dy, _sum_to(dy, shift)))


@jax.custom_vjp
def scaled(x: jax.Array, scale: jax.Array) -> jax.Array:
    """x * scale in the type of x; `scale` broadcasts."""
    return x * scale.astype(x.dtype)


def _scaled_backward(saved: tuple[jax.Array, jax.Array], dy: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, scale = saved
    return dy * scale.astype(dy.dtype), _sum_to(dy.astype(jnp.float32) * x.astype(jnp.float32), scale)


scaled.defvjp(lambda x, scale: (scaled(x, scale), (x, scale)), _scaled_backward)


@jax.custom_vjp
def replaced(x: jax.Array, where: jax.Array, vector: jax.Array) -> jax.Array:
    """x [..., D], replaced by `vector` (which broadcasts) where `where`, bool [...], is True; in the type of x."""
    return jnp.where(where[..., None], vector.astype(x.dtype), x)


def _replaced_backward(saved: tuple[jax.Array, jax.Array], dy: jax.Array) -> tuple[jax.Array, None, jax.Array]:
    where, vector = saved
    where = where[..., None]
    return jnp.where(where, 0, dy), None, _sum_to(jnp.where(where, dy, 0), vector)


replaced.defvjp(lambda x, where, vector: (replaced(x, where, vector), (where, vector)), _replaced_backward)


def _sum_to(dy: jax.Array, like: jax.Array) -> jax.Array:
    """The gradient of an array that was broadcast from the shape of `like`: `dy` summed, in float32, to that shape, and
    in the type of `like`."""
    leading = dy.ndim - like.ndim
    axes = [axis for axis in range(dy.ndim) if axis < leading or like.shape[axis - leading] < dy.shape[axis]]
    total = jnp.sum(dy.astype(jnp.float32), axis=axes, keepdims=True)
    return total.reshape(like.shape).astype(like.dtype)
