"""The mesh: the place of each device on the axes `data`, `fsdp` and `tensor`.

`data` splits the batch, `fsdp` the batch and the storage of parameters, `tensor` the computation of one example.
`tensor` communicates most and gets neighbouring devices; `data` communicates least and goes across slices of a machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import numpy as np
from jax.experimental import mesh_utils
from jax.sharding import AxisType, Mesh

from hma_jax.config import ConfigError, MeshConfig, ModelConfig, require
from hma_jax.runtime.heap_holes import fill_holes_after_compiling
from hma_jax.runtime.sharding import MESH_AXES


def make_mesh(config: MeshConfig, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """The mesh of `config` over `devices` (default: those of all processes). Raises ConfigError if they do not fit.

    On CPUs, programs compiled from now on leave no holes in the heap (`hma_jax.runtime.heap_holes`).
    """
    devices = jax.devices() if devices is None else devices
    sizes = mesh_sizes(config, len(devices))
    fill_holes_after_compiling(devices[0].platform)
    return Mesh(arrange(sizes, devices), MESH_AXES, axis_types=(AxisType.Auto,) * 3)


def mesh_sizes(config: MeshConfig, devices: int) -> list[int]:
    """The sizes of the mesh's axes over `devices` devices, with -1 filled in. Raises ConfigError if they do not fit."""
    sizes = [config.data, config.fsdp, config.tensor]
    if -1 in sizes and devices % config.min_devices == 0:
        sizes[sizes.index(-1)] = devices // config.min_devices
    require(
        math.prod(sizes) == devices,
        f"a mesh of data={config.data}, fsdp={config.fsdp}, tensor={config.tensor} does not "
        f"fit {devices} device(s); set one axis to -1 or change the sizes",
    )
    return sizes


def arrange(sizes: Sequence[int], devices: Sequence[jax.Device]) -> np.ndarray:
    """Devices as an array of `sizes` in which neighbours on an axis are neighbours in the machine.

    Slices (of TPUs, or of GPUs without NVLink between them) are joined along `data` as far as possible, then along
    `fsdp`, then along `tensor`. Raises ConfigError for slices of unequal size.
    """
    slices = len({getattr(device, "slice_index", 0) for device in devices})
    if slices == 1:
        return mesh_utils.create_device_mesh(sizes, devices, allow_split_physical_axes=True)
    outer = split_over_slices(sizes, slices)
    inner = [size // ways for size, ways in zip(sizes, outer, strict=True)]
    try:
        return mesh_utils.create_hybrid_device_mesh(inner, outer, devices, allow_split_physical_axes=True)
    except ValueError as error:
        raise ConfigError(f"no mesh can be made of the {len(devices)} devices of {slices} slices: {error}") from error


def split_over_slices(sizes: Sequence[int], slices: int) -> list[int]:
    """The number of slices along each axis. The product of these numbers is `slices`, which divides that of `sizes`."""
    outer = []
    for size in sizes:
        outer.append(math.gcd(size, slices))
        slices //= outer[-1]
    return outer


def check_mesh(mesh: Mesh, model: ModelConfig, batch: int, accumulate: int = 1) -> None:
    """Raises ConfigError if a batch, or a size of the model that `tensor` splits, does not divide over the mesh."""
    check_sizes([mesh.shape[axis] for axis in MESH_AXES], model, batch, accumulate)


def check_sizes(sizes: Sequence[int], model: ModelConfig, batch: int, accumulate: int = 1) -> None:
    """`check_mesh` by the sizes of the mesh's axes, for devices that this process does not have."""
    data, fsdp, tensor = sizes
    parts = f" in {accumulate} micro-batches" if accumulate > 1 else ""
    require(
        batch % (data * fsdp * accumulate) == 0,
        f"a batch of {batch}{parts} cannot be divided over data={data} x fsdp={fsdp} devices; make it a multiple of "
        f"{data * fsdp * accumulate}, or change the mesh",
    )
    for name, size in (("heads", model.heads), ("mlp_width", model.mlp_width)):
        require(
            size % tensor == 0,
            f"tensor={tensor} does not divide the model's {name} of {size}; choose a tensor axis that does",
        )
