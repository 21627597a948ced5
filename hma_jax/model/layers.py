"""The few layers of which everything is made. Each declares its parameters through `params.param`.

Two indices name an example's robot. `embodiment_B` is the robot's row in the embodiment table; `robot_row_B` is its row
on the embodiment axis of the parameters at hand. They differ in a training step, which holds the parameters of only a
few robots (`hma_jax.training.active_robots`).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.kernels.dense import (
    contract,
    per_robot,
    per_robot_from_actions,
    per_robot_to_actions,
    take_by_robot,
)
from hma_jax.kernels.pointwise import layer_norm, scaled, shifted
from hma_jax.model.params import Initializer, Role, bias, layouts_of, ones, param
from hma_jax.runtime.sharding import Layouts

BLOCK_EPS = 1e-5
FINE_EPS = 1e-6  # modulation, diffusion heads and the norms around the continuous trunk


class LayerNorm(nnx.Module):
    """Layer norm over one width axis, with gain and bias."""

    def __init__(self, width: int, axis: str | None = "D", eps: float = BLOCK_EPS):
        self.gain = param((width,), (axis,), ones, role="vector")
        self.bias = bias((width,), (axis,))
        self.eps = eps

    def __call__(self, x: jax.Array) -> jax.Array:
        return shifted(scaled(layer_norm(x, self.eps), self.gain.get_value()), self.bias.get_value())


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
        precise: bool = False,
    ):
        self.kernel = param(sizes, axes, init, role=role, precise=precise)
        self.bias = bias((sizes[1],), (axes[1],)) if with_bias else None

    def __call__(self, x: jax.Array, dtype: jnp.dtype | None = None) -> jax.Array:
        """x [..., in] -> [..., out] in the type of x, or in `dtype`, in which it is then summed."""
        y = contract(x, self.kernel.astype(x.dtype), dtype=dtype)
        return y if self.bias is None else shifted(y, self.bias.get_value())


class EmbodimentLinear(nnx.Module):
    """One linear map per robot; `robot_row_B` is the index of each example's map."""

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
        self.bias = bias((embodiments, sizes[1]), ("E", axes[1]), precise=axes[1] == "U")  # float32, as `to_actions` is
        self.map = find_map(axes)

    def __call__(self, x: jax.Array, robot_row_B: jax.Array) -> jax.Array:
        """x [B, ..., in] -> [B, ..., out]."""
        y = self.map(x, self.kernel.astype(x.dtype), robot_row_B, layouts_of(self.kernel))
        return shifted(y, robot_vectors(self.bias, robot_row_B, x))


def find_map(axes: tuple[str, str]) -> Callable[[jax.Array, jax.Array, jax.Array, Layouts | None], jax.Array]:
    """The function that multiplies each example by its robot's matrix. Results must not depend on U, which the widest
    robot determines."""
    if axes[0] == "U":
        return per_robot_from_actions
    return per_robot_to_actions if axes[1] == "U" else per_robot


def robot_vectors(vectors: nnx.Param, robot_row_B: jax.Array, like: jax.Array) -> jax.Array:
    """`vectors` [E, D] -> each example's own, [B, 1, ..., D], shaped to broadcast against `like` [B, ..., D]."""
    taken = take_by_robot(vectors.get_value(), robot_row_B, layouts_of(vectors))
    return taken.reshape(len(taken), *(1,) * (like.ndim - 2), -1)
