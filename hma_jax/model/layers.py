"""The few layers everything is made of. Each declares its parameters through `params.param`."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.params import Initializer, Role, bias, ones, param

BLOCK_EPS = 1e-5
FINE_EPS = 1e-6  # modulation, diffusion heads and the norms around the continuous trunk


@partial(jax.checkpoint, prevent_cse=False, static_argnums=(1,))
def normalise(x: jax.Array, eps: float) -> jax.Array:
    """x with zero mean and unit variance over its last axis; statistics in float32."""
    x32 = x.astype(jnp.float32)
    mean = jnp.mean(x32, axis=-1, keepdims=True)
    centred = x32 - mean
    variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
    return (centred * jax.lax.rsqrt(variance + eps)).astype(x.dtype)


@partial(jax.checkpoint, prevent_cse=False)
def gelu(x: jax.Array) -> jax.Array:
    """The exact one, x times the normal distribution function of x; only x is kept for the backward pass."""
    return jax.nn.gelu(x, approximate=False)


class LayerNorm(nnx.Module):
    """Layer norm over one width axis, with gain and bias."""

    def __init__(self, width: int, axis: str | None = "D", eps: float = BLOCK_EPS):
        self.gain = param((width,), (axis,), ones, role="vector")
        self.bias = bias((width,), (axis,))
        self.eps = eps

    def __call__(self, x: jax.Array) -> jax.Array:
        return normalise(x, self.eps) * self.gain.astype(x.dtype) + self.bias.astype(x.dtype)


class Linear(nnx.Module):
    """y = x W + b over the last axis. `axes` names W's two dimensions."""

    def __init__(
        self,
        sizes: tuple[int, int],
        axes: tuple[str | None, str | None],
        *,
        init: Initializer,
        role: Role,
        with_bias: bool = True,
    ):
        self.kernel = param(sizes, axes, init, role=role)
        self.bias = bias((sizes[1],), (axes[1],)) if with_bias else None

    def __call__(self, x: jax.Array) -> jax.Array:
        y = contract(x, self.kernel.astype(x.dtype))
        return y if self.bias is None else y + self.bias.astype(x.dtype)


class EmbodimentLinear(nnx.Module):
    """One linear map per robot. Each example of a batch uses its own robot's slice."""

    def __init__(
        self,
        embodiments: int,
        sizes: tuple[int, int],
        axes: tuple[str, str],
        *,
        init: Initializer,
        role: Role,
    ):
        self.kernel = param((embodiments, *sizes), ("E", *axes), init, role=role)
        self.bias = bias((embodiments, sizes[1]), ("E", axes[1]))

    def __call__(self, x: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """x [B, ..., in] -> [B, ..., out]."""
        y = per_example(x, self.kernel, embodiment_B)
        offset = jnp.take(self.bias.get_value(), embodiment_B, axis=0).astype(x.dtype)
        return y + offset.reshape(-1, *(1,) * (x.ndim - 2), y.shape[-1])


def per_example(x: jax.Array, kernel: nnx.Param, embodiment_B: jax.Array) -> jax.Array:
    """x [B, ..., in] times each example's own slice of a kernel [E, in, out] -> [B, ..., out]."""
    own = jnp.take(kernel.get_value(), embodiment_B, axis=0).astype(x.dtype)
    rows = x.reshape(x.shape[0], -1, x.shape[-1])
    y = jax.vmap(contract)(rows, own)
    return y.reshape(*x.shape[:-1], y.shape[-1])


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def contract(x: jax.Array, w: jax.Array, axes: int = 1) -> jax.Array:
    """x [..., in] times w [in, ...]; with `axes` 2 both have two axes for `in`.

    The gradient is the usual one, written out because XLA on CPU transposes one of the two
    activations for that of w: here the narrower one, where jax's own gradient leaves no choice.
    """
    return jnp.tensordot(x, w, axes)


def _contract_forward(x: jax.Array, w: jax.Array, axes: int) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return contract(x, w, axes), (x, w)


def _contract_backward(axes: int, kept: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, w = kept
    rows, outs = tuple(range(x.ndim - axes)), w.ndim - axes
    to_x = jnp.tensordot(g, w, (tuple(range(g.ndim - outs, g.ndim)), tuple(range(axes, w.ndim))))
    if math.prod(w.shape[:axes]) <= math.prod(w.shape[axes:]):
        return to_x, jnp.tensordot(x, g, (rows, rows))
    turned = jnp.tensordot(g, x, (rows, rows))
    return to_x, jnp.moveaxis(turned, tuple(range(outs)), tuple(range(axes, w.ndim)))


contract.defvjp(_contract_forward, _contract_backward)
