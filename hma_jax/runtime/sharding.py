"""One mesh, one table from logical axes to mesh axes, and a record of every decision.

Mesh axes: `data` splits the batch, `fsdp` splits the batch and the width of parameters,
`tensor` splits heads, mlp width and vocabulary. Model code names logical axes at most.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, Sharding

from hma_jax.config import ConfigError, MeshConfig

RULES: dict[str, str | tuple[str, ...]] = {
    "B": ("data", "fsdp"),
    "D": "fsdp",
    "W": "fsdp",
    "D_out": "tensor",
    "H": "tensor",
    "F": "tensor",
    "V": "tensor",
}
"""Logical axis -> mesh axis (or axes). An axis that is not listed is replicated."""


def make_mesh(config: MeshConfig, devices: list[jax.Device] | None = None) -> Mesh:
    """The mesh of `config` over `devices` (default: all). Raises ConfigError if they do not fit."""
    devices = jax.devices() if devices is None else devices
    sizes = [config.data, config.fsdp, config.tensor]
    given = math.prod(s for s in sizes if s != -1)
    if -1 in sizes and len(devices) % given == 0:
        sizes[sizes.index(-1)] = len(devices) // given
    if math.prod(sizes) != len(devices):
        raise ConfigError(
            f"a mesh of data={config.data}, fsdp={config.fsdp}, tensor={config.tensor} does not "
            f"fit {len(devices)} device(s); set one axis to -1 or change the sizes"
        )
    return Mesh(
        np.array(devices).reshape(sizes), ("data", "fsdp", "tensor"), axis_types=(AxisType.Auto,) * 3
    )


def partition(axes: tuple[str | None, ...], shape: tuple[int, ...], mesh: Mesh) -> PartitionSpec:
    """Mesh axes for an array's logical axes; a dimension that does not divide stays whole."""
    spec: list[Any] = []
    for axis, size in zip(axes, shape, strict=True):
        target = RULES.get(axis) if axis else None
        names = (target,) if isinstance(target, str) else target or ()
        ways = math.prod(mesh.shape[name] for name in names)
        spec.append(target if ways > 1 and size % ways == 0 else None)
    return PartitionSpec(*spec)


def constrain(x: jax.Array, axes: tuple[str | None, ...]) -> jax.Array:
    """Pins an activation's layout under the current mesh (`jax.set_mesh`); without one, x."""
    if not is_split():
        return x
    mesh = jax.sharding.get_abstract_mesh()
    return jax.lax.with_sharding_constraint(x, partition(axes, x.shape, mesh))


def is_split() -> bool:
    """Whether what is traced runs under a mesh of several devices."""
    mesh = jax.sharding.get_abstract_mesh()
    return not mesh.empty and math.prod(mesh.shape.values()) > 1


class Spec(Protocol):
    """What a layout depends on, of one array (`model.params.ParamSpec`)."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def axes(self) -> tuple[str | None, ...]: ...
    @property
    def size(self) -> int: ...


class Declarations(Protocol):
    """Specs as a tree and by name (`model.params.Declared`)."""

    @property
    def specs(self) -> Any: ...
    def leaves(self) -> Mapping[str, Spec]: ...


@dataclass(frozen=True)
class Decision:
    """How one parameter lies on the mesh, and why if it is whole on every device."""

    name: str
    spec: Spec
    partition: PartitionSpec
    reason: str

    @property
    def replicated(self) -> bool:
        return all(p is None for p in self.partition)


def plan_sharding(declared: Declarations, mesh: Mesh, config: MeshConfig) -> list[Decision]:
    """One decision per parameter, in the order of `declared.leaves()`."""
    decisions = []
    for name, spec in declared.leaves().items():
        if spec.size < config.min_shard_size:
            layout, reason = PartitionSpec(*[None] * len(spec.shape)), "small"
        else:
            layout = partition(spec.axes, spec.shape, mesh)
            whole = all(p is None for p in layout)
            reason = "no axis divides" if whole else "by its axes"
        decisions.append(Decision(name, spec, layout, reason))
    return decisions


def audit_sharding(decisions: list[Decision], mesh: Mesh, limit: float = 0.02) -> None:
    """Raises ConfigError when more than `limit` of all parameters is replicated, naming them.

    Only a mesh that splits parameters (fsdp or tensor above 1) is audited.
    """
    if mesh.shape["fsdp"] * mesh.shape["tensor"] == 1:
        return
    total = sum(d.spec.size for d in decisions)
    whole = sum(d.spec.size for d in decisions if d.replicated)
    if whole > limit * total:
        worst = sorted((d for d in decisions if d.replicated), key=lambda d: -d.spec.size)[:5]
        raise ConfigError(
            f"{whole / total:.1%} of the parameters would be replicated on every device (limit "
            f"{limit:.0%}): " + ", ".join(f"{d.name} {d.spec.shape} ({d.reason})" for d in worst)
        )


def describe_sharding(decisions: list[Decision]) -> str:
    """A table of all decisions, for people and for tests."""
    rows = [f"{d.name:48} {str(d.spec.shape):24} {d.partition}  {d.reason}" for d in decisions]
    return "\n".join(rows)


def param_shardings(declared: Declarations, mesh: Mesh, config: MeshConfig) -> Any:
    """A tree of NamedSharding with the structure of the parameters."""
    layouts = {d.name: NamedSharding(mesh, d.partition) for d in plan_sharding(declared, mesh, config)}
    treedef = jax.tree.structure(declared.specs, is_leaf=lambda leaf: hasattr(leaf, "axes"))
    return jax.tree.unflatten(treedef, list(layouts.values()))


def place(array: np.ndarray, sharding: Sharding | None) -> jax.Array:
    """A host array on devices, shard by shard: each gets its own part and never more. Without a
    sharding, on the default device."""
    if sharding is None:
        return jax.device_put(array)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """The leading axis of every array of a batch, over data and fsdp together."""
    return NamedSharding(mesh, PartitionSpec(RULES["B"]))


def put_batch(batch: Any, mesh: Mesh) -> Any:
    """This process's rows of a global batch -> global device arrays."""
    sharding = batch_sharding(mesh)
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, x), batch)
