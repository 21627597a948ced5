"""Parameters are declared once, by `param`; everything else is derived from that declaration.

A declaration says shape, logical axes (in the dimension letters), initialiser, muP role and
whether weight decay applies. From it come the arrays (`Declared.init`), their sharding
(`runtime.sharding`), the optimiser's multipliers, decay mask and embodiment axis
(`training.optimizer`), and the counts. Flax NNX modules hold declarations; jitted functions are pure functions of the
plain nested dict of arrays that `Declared.init` returns.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import PartitionSpec

from hma_jax.config import MeshConfig, require
from hma_jax.kernels import remat
from hma_jax.runtime.sharding import Layouts, find_layouts, for_compute, is_split, place

M = TypeVar("M", bound=nnx.Module)

Params = Any
"""A nested dict of arrays, the structure of `Declared.specs`."""

Role = Literal["hidden", "input", "output", "vector"]
"""A parameter's role in muP: `hidden` has two axes that grow with width, `input` and `output` one (from and to a fixed
size), `vector` is a bias, a gain or an embedding."""

Use = Literal["always", "actions_shown", "actions_hidden", "actions_predicted", "frames_predicted"]
"""The examples that train a parameter. A step without such an example leaves it unchanged, like the parameters of an
absent robot: no update, no decay, no count."""

MatrixAxes = tuple[tuple[int, ...], tuple[int, ...]]
"""The axes, counted from the last, that a `hidden` parameter maps from and to. The other axes stack several such
matrices."""

Initializer = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
"""init(rng, shape) -> float32 array."""

LAYER_AXIS = "N"
EMBODIMENT_AXIS = "E"


@dataclass(frozen=True)
class ParamSpec:
    """The declaration of one array."""

    shape: tuple[int, ...]
    axes: tuple[str | None, ...]
    role: Role
    decay: bool
    init: Initializer
    use: Use = "always"
    precise: bool = False  # used in float32, whatever the model's compute type
    matrix: MatrixAxes = ((-2,), (-1,))

    @property
    def embodiment_axis(self) -> int | None:
        """Position of E, or None for a parameter that all robots share."""
        return self.axes.index(EMBODIMENT_AXIS) if EMBODIMENT_AXIS in self.axes else None

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def along_robots(self, x_E: jax.Array) -> jax.Array:
        """One value per robot, shaped to broadcast against this parameter, which must have an embodiment axis."""
        return x_E.reshape([-1 if axis == self.embodiment_axis else 1 for axis in range(len(self.shape))])


def param(
    shape: tuple[int, ...],
    axes: tuple[str | None, ...],
    init: Initializer,
    *,
    role: Role,
    decay: bool = True,
    precise: bool = False,
    matrix: MatrixAxes = ((-2,), (-1,)),
) -> nnx.Param:
    """Declares one float32 parameter. `axes` names each dimension of `shape` (None: unnamed).

    No array is made here: `Declared.init` makes them all.
    """
    require(len(shape) == len(axes), f"a parameter of shape {shape} needs {len(shape)} axes, got {axes}")
    about = {"axes": axes, "init": init, "role": role, "decay": decay, "precise": precise, "matrix": matrix}
    return nnx.Param(jax.ShapeDtypeStruct(shape, jnp.float32), use="always", **about)


def bias(shape: tuple[int, ...], axes: tuple[str | None, ...], precise: bool = False) -> nnx.Param:
    """Declares a bias: zero at first, never decayed."""
    return param(shape, axes, zeros, role="vector", decay=False, precise=precise)


def zeros(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    del rng
    return np.zeros(shape, np.float32)


def ones(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    del rng
    return np.ones(shape, np.float32)


def uniform(rng: np.random.Generator, shape: tuple[int, ...], bound: float | np.ndarray) -> np.ndarray:
    """Uniform in +-`bound`, which may vary over the array."""
    # In place: every process draws each array whole, and a copy of the largest takes gigabytes.
    x = rng.random(shape, np.float32)
    x *= 2
    x -= 1
    x *= bound
    return x


def normal(std: float) -> Initializer:
    def draw(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        x = rng.standard_normal(shape, np.float32)
        x *= np.float32(std)
        return x

    return draw


def xavier_uniform(fan_in: float, fan_out: float, gain: float = 1.0) -> Initializer:
    """Uniform in +-gain * sqrt(6 / (fan_in + fan_out)).

    Fans are arguments, not read from the shape: a fused, stacked or per-embodiment array has more axes than the matrix
    it represents.
    """
    bound = gain * math.sqrt(6.0 / (fan_in + fan_out))
    return lambda rng, shape: uniform(rng, shape, bound)


def stack(make: Callable[[], M], count: int, axis: str = LAYER_AXIS) -> M:
    """`count` modules as one module whose parameters have a leading axis; `axis` names it, by default the axis of
    layers."""
    module = make()
    for variable in _params(module):
        one = variable.get_value()
        variable.set_value(jax.ShapeDtypeStruct((count, *one.shape), one.dtype))
        variable.set_metadata(axes=(axis, *variable.axes))
    return module


def used(use: Use, module: M) -> M:
    """`module`, all of whose parameters now have this `use`."""
    for variable in _params(module):
        variable.set_metadata(use=use)
    return module


def _params(module: nnx.Module) -> list[nnx.Param]:
    return [node for _, node in nnx.iter_graph(module) if isinstance(node, nnx.Param)]


@dataclass(frozen=True, eq=False)  # compared by identity, so that it can be a static argument of `jax.jit`
class Declared(Generic[M]):
    """A module's static structure and the specs of its parameters, without arrays."""

    graphdef: nnx.GraphDef = field(repr=False)
    specs: Params = field(repr=False)  # nested dict of ParamSpec
    min_shard_size: int

    def init(self, seed: int, shardings: Params | None = None) -> Params:
        """Arrays for every declaration, laid out by `shardings` (default: on the default device).

        Each is drawn on the host (`draw`): nothing is compiled, and the values do not depend on the mesh. Arrays are
        drawn one at a time and placed shard by shard, so that no device ever holds a whole copy of a split array.
        """

        def make(path: tuple[Any, ...], spec: ParamSpec, sharding: jax.sharding.Sharding | None = None) -> jax.Array:
            return place(draw(seed, path, spec), sharding)

        given = () if shardings is None else (shardings,)
        return jax.tree.map_with_path(make, self.specs, *given, is_leaf=is_spec)

    def shapes(self, shardings: Params | None = None) -> Params:
        """What `init` would return, without making it: a tree of jax.ShapeDtypeStruct."""

        def describe(spec: ParamSpec, sharding: jax.sharding.Sharding | None = None) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(spec.shape, jnp.float32, sharding=sharding)

        given = () if shardings is None else (shardings,)
        return jax.tree.map(describe, self.specs, *given, is_leaf=is_spec)

    def merge(self, params: Params) -> M:
        """The module with `params` in it; call it inside the traced function.

        On a mesh, parameters without a layer or embodiment axis are put into their compute layout here; those of layers
        inside the loop over layers (`layer_for_compute`), and those of robots where they meet their examples
        (`kernels.dense`).
        """
        specs = nnx.traversals.flatten_mapping(self.specs)
        flat = {
            tuple(int(k) if k.isdigit() else k for k in path): self._variable(specs[path], value)
            for path, value in nnx.traversals.flatten_mapping(params).items()
        }
        return nnx.merge(self.graphdef, nnx.from_flat_state(flat))

    def _variable(self, spec: ParamSpec, value: jax.Array) -> nnx.Param:
        layouts = find_layouts(spec.axes, spec.shape, self.min_shard_size)
        if layouts and spec.embodiment_axis is None and LAYER_AXIS not in spec.axes:
            value = for_compute(value, layouts)
        return nnx.Param(value, axes=spec.axes, role=spec.role, precise=spec.precise, layouts=layouts)

    def leaves(self) -> dict[str, ParamSpec]:
        """'path/of/parameter' -> spec, in a fixed order."""
        flat = jax.tree.leaves_with_path(self.specs, is_leaf=is_spec)
        return {path_name(path): spec for path, spec in flat}

    def count(self) -> int:
        return sum(spec.size for spec in self.leaves().values())


def declare(make: Callable[[], M], min_shard_size: int = MeshConfig.min_shard_size) -> Declared[M]:
    """Reads the declarations of the module that `make` returns."""
    graphdef, state, _ = nnx.split(make(), nnx.Param, ...)
    # List indices become strings: checkpoints keep dictionaries with string keys only.
    flat = {tuple(map(str, path)): _spec(variable) for path, variable in nnx.to_flat_state(state)}
    return Declared(graphdef, nnx.traversals.unflatten_mapping(flat), min_shard_size)


def draw(seed: int, path: tuple[Any, ...], spec: ParamSpec) -> np.ndarray:
    """One array of `Declared.init`, a function of (seed, its path) alone: adding a parameter does not change the
    others."""
    words = np.frombuffer(hashlib.sha256(path_name(path).encode()).digest(), np.uint32)
    return spec.init(np.random.default_rng([seed, *words.tolist()]), spec.shape)


def is_spec(leaf: Any) -> bool:
    """For `is_leaf` when mapping over `Declared.specs`."""
    return isinstance(leaf, ParamSpec)


def layer_for_compute(layer: nnx.State, dtype: jnp.dtype) -> nnx.State:
    """One layer's slices of stacked parameters, in their compute layout on the current mesh. Matrices are communicated
    in `dtype`, to which they would be cast anyway. Without a mesh, `layer` itself."""
    if not is_split():
        return layer

    def sent(variable: nnx.Param) -> nnx.Param:
        w, (storage, compute) = variable.get_value(), variable.layouts
        layouts = PartitionSpec(*storage[1:]), PartitionSpec(*compute[1:])
        if EMBODIMENT_AXIS not in variable.axes:
            w = remat.tag_gathered(for_compute(w, layouts, None if variable.role == "vector" else dtype))
        about = {"role": variable.role, "precise": variable.precise}
        return nnx.Param(w, axes=variable.axes[1:], layouts=layouts, **about)

    return jax.tree.map(sent, layer, is_leaf=lambda leaf: isinstance(leaf, nnx.Variable))


def layouts_of(variable: nnx.Param) -> Layouts | None:
    """(storage, compute) layouts of a parameter with an axis of robots, E, inside a merged module; None without a
    mesh."""
    return variable.get_metadata().get("layouts")


def inference_params(declared: Declared, params: Params, dtype: str) -> Params:
    """Parameters as generation and evaluation use them: in `dtype`, cast once, so that in bfloat16 a pass reads half
    the bytes. The results are the same, because a pass would cast them too. Arrays of one axis and those that are used
    in float32 (`ParamSpec.precise`) stay as they are."""

    def cast(spec: ParamSpec, x: jax.Array) -> jax.Array:
        return x if x.ndim < 2 or spec.precise else x.astype(jnp.dtype(dtype), copy=False)

    return jax.tree.map(cast, declared.specs, params, is_leaf=is_spec)


def require_params(declared: Declared, params: Params, what: str) -> None:
    """Raises ConfigError, which begins with `what`, unless `params` have the declared names and shapes."""
    expected = {name: spec.shape for name, spec in declared.leaves().items()}
    given = {path_name(path): tuple(x.shape) for path, x in jax.tree.leaves_with_path(params)}
    for name in sorted(expected.keys() | given.keys()):
        require(
            expected.get(name) == given.get(name),
            f"{what}: {name} should be {expected.get(name, 'absent')} but is {given.get(name, 'absent')}",
        )


def path_name(path: tuple[Any, ...]) -> str:
    """'trunk/blocks/space/qkv' from a jax key path."""
    return "/".join(str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", k)))) for k in path)


def _spec(v: nnx.Param) -> ParamSpec:
    return ParamSpec(v.get_value().shape, v.axes, v.role, v.decay, v.init, v.use, v.precise, v.matrix)
