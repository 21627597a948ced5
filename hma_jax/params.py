"""Parameters are declared once, by `param`; everything else is derived from that declaration.

A declaration says shape, logical axes (in the dimension letters), initialiser, muP role and
whether weight decay applies. From it come the arrays (`init_params`), their sharding
(`training.sharding`), the optimiser's multipliers, decay mask and embodiment axis
(`training.optimizer`), and the counts. Flax NNX modules hold declarations; what is jitted
are pure functions of the plain nested dict of arrays that `init_params` returns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import require

Params = Any
"""A nested dict of arrays, the structure of `Declared.specs`."""

Role = Literal["hidden", "input", "output", "vector"]
"""What width does to a parameter (muP): `hidden` has two axes that grow with width, `input`
and `output` one (from and to a fixed size), `vector` is a bias, a gain or an embedding."""

Initializer = Callable[[jax.Array, tuple[int, ...], Any], jax.Array]

LAYER_AXIS = "N"
EMBODIMENT_AXIS = "E"


@dataclass(frozen=True)
class ParamSpec:
    """What a declaration says of one array."""

    shape: tuple[int, ...]
    axes: tuple[str | None, ...]
    role: Role
    decay: bool

    @property
    def embodiment_axis(self) -> int | None:
        """Position of E, or None for a parameter that all robots share."""
        return self.axes.index(EMBODIMENT_AXIS) if EMBODIMENT_AXIS in self.axes else None

    @property
    def size(self) -> int:
        return math.prod(self.shape)


def param(
    rngs: nnx.Rngs,
    shape: tuple[int, ...],
    axes: tuple[str | None, ...],
    init: Initializer,
    *,
    role: Role,
    decay: bool = True,
) -> nnx.Param:
    """Declares one float32 parameter. `axes` names each dimension of `shape` (None: unnamed)."""
    require(len(shape) == len(axes), f"a parameter of shape {shape} needs {len(shape)} axes, got {axes}")
    return nnx.Param(init(rngs.params(), shape, jnp.float32), axes=axes, role=role, decay=decay)


def zeros(key: jax.Array, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    del key
    return jnp.zeros(shape, dtype)


def ones(key: jax.Array, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    del key
    return jnp.ones(shape, dtype)


def bias(rngs: nnx.Rngs, shape: tuple[int, ...], axes: tuple[str | None, ...]) -> nnx.Param:
    """Declares a bias: zero at first, never decayed."""
    return param(rngs, shape, axes, zeros, role="vector", decay=False)


def normal(std: float) -> Initializer:
    return lambda key, shape, dtype: std * jax.random.normal(key, shape, dtype)


def xavier_uniform(fan_in: int, fan_out: int, gain: float = 1.0) -> Initializer:
    """Uniform in +-gain * sqrt(6 / (fan_in + fan_out)).

    Fans are given, not read off the shape: a fused or per-embodiment array has more axes than
    the matrix it stands for.
    """
    bound = gain * math.sqrt(6.0 / (fan_in + fan_out))
    return lambda key, shape, dtype: jax.random.uniform(key, shape, dtype, -bound, bound)


def stack(make: Callable[[nnx.Rngs], nnx.Module], count: int, rngs: nnx.Rngs) -> nnx.Module:
    """`count` modules as one whose parameters have a leading layer axis N."""

    @nnx.split_rngs(splits=count)
    @nnx.vmap(in_axes=(0,), out_axes=0)
    def build(rngs: nnx.Rngs) -> nnx.Module:
        return make(rngs)

    return build(rngs)


@dataclass(frozen=True)
class Declared:
    """A module's static structure and the specs of its parameters, without arrays."""

    make: Callable[[nnx.Rngs], nnx.Module]
    graphdef: nnx.GraphDef
    specs: Params  # nested dict of ParamSpec

    def init(self, seed: int) -> Params:
        """Arrays for every declaration, a function of `seed` alone."""

        def build(key: jax.Array) -> Params:
            state = nnx.state(self.make(nnx.Rngs(params=key)), nnx.Param)
            return _map_variables(state, lambda variable: variable.get_value())

        return jax.jit(build)(jax.random.key(seed))

    def merge(self, params: Params) -> nnx.Module:
        """The module around `params`; call it inside the traced function."""
        return merge(self.graphdef, params)

    def leaves(self) -> dict[str, ParamSpec]:
        """'path/of/parameter' -> spec, in a fixed order."""
        flat, _ = jax.tree.flatten_with_path(self.specs, is_leaf=lambda s: isinstance(s, ParamSpec))
        return {path_name(path): spec for path, spec in flat}

    def count(self) -> int:
        return sum(spec.size for spec in self.leaves().values())


def declare(make: Callable[[nnx.Rngs], nnx.Module]) -> Declared:
    """Traces `make` abstractly (no arrays are allocated) and reads its declarations."""
    module = nnx.eval_shape(lambda: make(nnx.Rngs(params=0)))
    graphdef, state, _ = nnx.split(module, nnx.Param, ...)
    return Declared(make, graphdef, _map_variables(state, _spec))


def merge(graphdef: nnx.GraphDef, params: Params) -> nnx.Module:
    """A module from its static structure and a nested dict of arrays."""
    flat = {
        tuple(int(k) if k.isdigit() else k for k in path): nnx.Param(value)
        for path, value in nnx.traversals.flatten_mapping(params).items()
    }
    return nnx.merge(graphdef, nnx.State.from_flat_path(flat))


def path_name(path: tuple[Any, ...]) -> str:
    """'trunk/blocks/spatial/qkv' from a jax key path."""
    return "/".join(str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", k)))) for k in path)


def _spec(variable: nnx.Param) -> ParamSpec:
    shape = tuple(variable.get_value().shape)
    axes = tuple(variable.axes)
    if len(shape) == len(axes) + 1:  # made by `stack`
        axes = (LAYER_AXIS, *axes)
    return ParamSpec(shape, axes, variable.role, variable.decay)


def _map_variables(state: nnx.State, fn: Callable[[nnx.Param], Any]) -> Params:
    # List indices become strings: checkpoints keep dictionaries with string keys only.
    flat = {tuple(str(k) for k in path): fn(variable) for path, variable in nnx.to_flat_state(state)}
    return nnx.traversals.unflatten_mapping(flat)
