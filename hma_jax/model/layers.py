"""The few layers everything is made of. Each declares its parameters through `params.param`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.kernels.ops import contract, normalise
from hma_jax.model.params import Initializer, Role, bias, ones, param

BLOCK_EPS = 1e-5
FINE_EPS = 1e-6  # modulation, diffusion heads and the norms around the continuous trunk


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
