"""Two tables from logical axes to mesh axes: layouts of stored arrays, and layouts for computing.

`STORAGE` is for parameters, their moments and gradients, `COMPUTE` for activations and for parameters in use. A
parameter is moved from one layout to the other where it is used (`for_compute`; for parameters of layers, inside the
loop over layers), and its gradient is moved back. `hma_jax.kernels.dense` does this for per-robot parameters. Model
code names only logical axes. The mesh is made in `mesh`; decisions are printed and audited in `audit`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding

Axes = tuple[str | None, ...]
"""A dimension letter for each dimension of an array; None: no name."""

Rules = tuple[tuple[str, tuple[str, ...]], ...]
"""(logical axis, mesh axes), in order of priority. The mesh axes split the first dimension of that name that they
divide; each mesh axis is used once."""

MESH_AXES = ("data", "fsdp", "tensor")
"""The axes of every mesh that this package makes (`mesh`)."""

BATCH = ("data", "fsdp")
"""The mesh axes over which examples are split."""

STORAGE: Rules = (
    ("H", ("tensor",)),
    ("F", ("tensor",)),
    ("V", ("tensor",)),
    ("D_out", ("tensor",)),
    # Widths come first. A step takes its robots' slices out of arrays that hold all robots: where these are split by
    # width, every device takes its own part and nothing is sent. E comes last, for arrays without a width that divides.
    ("D", ("fsdp",)),
    ("W", ("fsdp",)),
    ("F", ("fsdp",)),
    ("D_out", ("fsdp",)),
    ("V", ("fsdp",)),
    ("U", ("fsdp",)),
    ("C", ("fsdp",)),
    ("P", ("fsdp",)),
    ("S", ("fsdp",)),
    ("E", ("fsdp",)),
)

COMPUTE: Rules = (
    ("B", BATCH),
    ("H", ("tensor",)),
    ("F", ("tensor",)),
    ("V", ("tensor",)),
    ("D_out", ("tensor",)),
)


def partition(axes: Axes, shape: tuple[int, ...], mesh: Any, rules: Rules = COMPUTE) -> PartitionSpec:
    """Mesh axes for each dimension of an array. A mesh axis that divides no dimension is not used."""
    split: list[tuple[str, ...]] = [()] * len(shape)
    for axis, names in rules:
        ways = math.prod(mesh.shape[name] for name in names)
        if ways == 1 or any(name in used for name in names for used in split):
            continue
        for place, (own, size) in enumerate(zip(axes, shape, strict=True)):
            if own == axis and size % (ways * math.prod(mesh.shape[name] for name in split[place])) == 0:
                split[place] = (*split[place], *names)
                break
    return PartitionSpec(*[names if len(names) > 1 else names[0] if names else None for names in split])


Layouts = tuple[PartitionSpec, PartitionSpec]
"""(storage, compute) layouts of one parameter."""


def find_layouts(axes: Axes, shape: tuple[int, ...], smallest: int) -> Layouts | None:
    """Layouts of a parameter of that shape under the current mesh; None without a mesh."""
    if not is_split():
        return None
    mesh = jax.sharding.get_abstract_mesh()
    return storage_partition(axes, shape, mesh, smallest), partition(axes, shape, mesh)


def storage_partition(axes: Axes, shape: tuple[int, ...], mesh: Any, smallest: int) -> PartitionSpec:
    """The layout of a parameter and its moments; with fewer than `smallest` elements it is on every device."""
    if math.prod(shape) < smallest:
        return PartitionSpec(*[None] * len(shape))
    return partition(axes, shape, mesh, STORAGE)


def constrain(x: jax.Array, axes: Axes) -> jax.Array:
    """Fixes an activation's layout under the current mesh (`jax.set_mesh`); without a mesh, returns x."""
    if not is_split():
        return x
    return pinned(x, *partition(axes, x.shape, jax.sharding.get_abstract_mesh()))


def pinned(x: jax.Array, *split: str | tuple[str, ...] | None) -> jax.Array:
    """x constrained to this layout on the current mesh; dimensions that do not divide stay unsplit."""
    mesh = jax.sharding.get_abstract_mesh()
    ways = [math.prod(mesh.shape[name] for name in mesh_axes(part)) for part in split]
    fitting = [part if size % n == 0 else None for part, size, n in zip(split, x.shape, ways, strict=True)]
    return jax.lax.with_sharding_constraint(x, PartitionSpec(*fitting))


def mesh_axes(part: str | tuple[str, ...] | None) -> tuple[str, ...]:
    """The mesh axes in `part`, the entry of one dimension in a PartitionSpec."""
    return (part,) if isinstance(part, str) else part or ()


def is_split() -> bool:
    """Whether the traced code runs under a mesh of several devices; code that `shard_map` runs on each device does not.
    Under a caller's own mesh, with other axes, no layout is set here: the caller and the compiler decide the
    shardings."""
    mesh = jax.sharding.get_abstract_mesh()
    ours = set(MESH_AXES) <= set(mesh.axis_names)
    return ours and math.prod(mesh.shape[axis] for axis in mesh.auto_axes) > 1


def batch_ways(mesh: Any) -> int:
    """The number of parts that a batch is split into. Only the shape of `mesh` is read."""
    return math.prod(mesh.shape[name] for name in BATCH)


GATHER, SCATTER = "gather_parameters", "scatter_gradients"
"""Scopes of the communication of `for_compute` in compiled programs."""


def for_compute(w: jax.Array, layouts: Layouts, dtype: Any = None) -> jax.Array:
    """w moved from its storage layout to its compute layout; its gradient is moved back.

    w is cast to `dtype` (default: its own) before it is sent; the gradient has the original type.
    """
    return _for_compute(w, layouts, w.dtype if dtype is None else dtype, w.dtype)


@partial(jax.custom_vjp, nondiff_argnums=(1, 2, 3))
def _for_compute(w: jax.Array, layouts: Layouts, sent_as: Any, own: Any) -> jax.Array:
    storage, compute = layouts
    w = pinned(w, *storage).astype(sent_as)
    with jax.named_scope(GATHER):
        return pinned(w, *compute)


def _for_compute_backward(layouts: Layouts, sent_as: Any, own: Any, _: None, dw: jax.Array) -> tuple[jax.Array]:
    with jax.named_scope(SCATTER):
        return (pinned(dw, *layouts[0]).astype(own),)


_for_compute.defvjp(lambda *args: (_for_compute(*args), None), _for_compute_backward)


def place(array: np.ndarray, sharding: Sharding | None) -> jax.Array:
    """A host array placed on devices shard by shard: each device gets only its own part. Without a sharding, on the
    default device."""
    if sharding is None:
        return jax.device_put(array)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """The leading axis of every array of a batch, over data and fsdp together."""
    return NamedSharding(mesh, PartitionSpec(BATCH))


def replicated(mesh: Mesh) -> NamedSharding:
    """The sharding in which every device has the whole array."""
    return NamedSharding(mesh, PartitionSpec())


def put_batch(batch: Any, mesh: Mesh) -> Any:
    """This process's rows of a global batch -> global device arrays."""
    sharding = batch_sharding(mesh)
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, x), batch)
