"""The layout of every parameter on a mesh, for printing and testing, and an audit of large parameters that are not
split."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hma_jax.config import ConfigError, MeshConfig
from hma_jax.runtime.sharding import STORAGE, mesh_axes, partition, storage_partition


class Spec(Protocol):
    """The properties of an array on which its layout depends (`model.params.ParamSpec`)."""

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
    """The layout of one parameter on a mesh, and the reason if it is not split."""

    name: str
    spec: Spec
    storage: PartitionSpec
    compute: PartitionSpec
    device_size: int  # elements that each device stores
    whole: bool  # not split along `splitting_axis`
    reason: str  # why it is whole; "" if it is not

    @property
    def shape(self) -> str:
        """'N 32, D 256': each dimension with its logical axis."""
        return ", ".join(f"{axis or '-'} {size}" for axis, size in zip(self.spec.axes, self.spec.shape, strict=True))


SMALL, NO_RULE, UNDIVIDED = "small", "no rule splits it", "no axis divides"
"""Reasons for which a parameter is whole. Only the last is the fault of the mesh's sizes."""

MAX_WHOLE = 0.02
"""The largest share of all parameters that may be whole because the mesh's sizes do not divide theirs."""


def splitting_axis(mesh: Any) -> str:
    """The mesh axis that has to split parameters: `fsdp`, or `tensor` where only that axis could."""
    return "fsdp" if mesh.shape["fsdp"] > 1 else "tensor"


def plan_sharding(declared: Declarations, mesh: Any, config: MeshConfig) -> list[Decision]:
    """One decision per parameter, in the order of `declared.leaves()`. Only the shape of `mesh` is read."""
    splitting = splitting_axis(mesh)
    splittable = {axis for axis, names in STORAGE if splitting in names}
    decisions = []
    for name, spec in declared.leaves().items():
        storage = storage_partition(spec.axes, spec.shape, mesh, config.min_shard_size)
        ways = math.prod(mesh.shape[axis] for axis in _mesh_axes(storage))
        whole = splitting not in _mesh_axes(storage)
        reason = ""
        if whole:
            small, ruled = spec.size < config.min_shard_size, splittable.intersection(spec.axes)
            reason = SMALL if small else UNDIVIDED if ruled else NO_RULE
        compute = partition(spec.axes, spec.shape, mesh)
        decisions.append(Decision(name, spec, storage, compute, spec.size // ways, whole, reason))
    return decisions


def audit_sharding(decisions: list[Decision], mesh: Any) -> None:
    """Raises ConfigError, which names the parameters, when more than MAX_WHOLE of them is whole.

    Only a mesh that splits parameters (fsdp or tensor above 1) is audited. Parameters do not count that are whole
    because they are small (`MeshConfig.min_shard_size`), or because no size of the mesh would split them, such as
    position tables where only tensor is above 1.
    """
    splitting = splitting_axis(mesh)
    if mesh.shape[splitting] == 1:
        return
    total = sum(d.spec.size for d in decisions)
    whole = [d for d in decisions if d.reason == UNDIVIDED]
    share = sum(d.spec.size for d in whole) / total
    if share > MAX_WHOLE:
        worst = sorted(whole, key=lambda d: -d.spec.size)[:5]
        raise ConfigError(
            f"{share:.1%} of the parameters would be replicated on every device (allowed: {MAX_WHOLE:.0%}): "
            + ", ".join(f"{d.name} {d.spec.shape}" for d in worst)
            + f"; {splitting}={mesh.shape[splitting]} divides no size of theirs that it may split: choose one that does"
        )


def describe_sharding(decisions: Iterable[Decision]) -> str:
    """One line per parameter: its layouts, and how much of it one device stores, in float32."""
    return "\n".join(
        f"{d.name} [{d.shape}]: stored {_words(d.storage)}, computed with {_words(d.compute)}, "
        f"{size_of(4 * d.device_size)}{f', {d.reason}' if d.whole else ''}"
        for d in decisions
    )


def size_of(count: int) -> str:
    """A number of bytes in words, such as '1.83 GiB'."""
    power = 0 if count < 2**10 else 1 if count < 2**20 else 2 if count < 2**30 else 3
    return f"{count / 2 ** (10 * power):,.{2 if power else 0}f} {('B', 'KiB', 'MiB', 'GiB')[power]}"


def param_shardings(declared: Declarations, mesh: Mesh, config: MeshConfig) -> Any:
    """A tree of NamedSharding with the structure of the parameters: where they are stored."""
    layouts = [NamedSharding(mesh, d.storage) for d in plan_sharding(declared, mesh, config)]
    treedef = jax.tree.structure(declared.specs, is_leaf=lambda leaf: hasattr(leaf, "axes"))
    return jax.tree.unflatten(treedef, layouts)


def _mesh_axes(layout: PartitionSpec) -> list[str]:
    return [name for part in layout for name in mesh_axes(part)]


def _words(layout: PartitionSpec) -> str:
    """'(fsdp, -)'; 'whole' where nothing is split."""
    parts = ["+".join(mesh_axes(part)) or "-" for part in layout]
    return f"({', '.join(parts)})" if set(parts) - {"-"} else "whole"
