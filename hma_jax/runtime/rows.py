"""Which rows of a global batch a process holds, how rows are split, and how host arrays are laid out over the devices
of many processes."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from einops import rearrange
from jax.sharding import Mesh

from hma_jax.config import MeshConfig, require
from hma_jax.runtime.mesh import make_mesh
from hma_jax.runtime.sharding import batch_sharding, batch_ways, place


def own_rows(mesh: Mesh | MeshConfig, batch: int) -> np.ndarray:
    """int64, ascending: the rows of a batch of `batch` that this process's devices compute.

    Processes that compute the same rows, such as those that share them along `tensor`, get the same ones: there is one
    global batch, whatever the number of processes. Raises ConfigError for a batch that does not split.
    """
    mesh = make_mesh(mesh) if isinstance(mesh, MeshConfig) else mesh
    if jax.process_count() == 1:
        return np.arange(batch)
    ways = batch_ways(mesh)
    require(
        batch % ways == 0,
        f"loader.batch {batch} cannot be divided over the {ways} devices of mesh.data x mesh.fsdp; change one of them",
    )
    parts = batch_sharding(mesh).addressable_devices_indices_map((batch,)).values()
    return np.unique(np.concatenate([np.arange(batch)[index] for index in parts]))


def split_rows(batch: Any, parts: int) -> Any:
    """Rows [B, ...] of each array as [n, B / n, ...], where n is `parts`: part i takes rows i, i + n, ..., so that
    every device keeps its rows."""
    return jax.tree.map(lambda x: rearrange(x, "(b n) ... -> n b ...", n=parts), batch)


def lay_out(tree: Any, shardings: Any) -> Any:
    """Arrays, on the host or on devices, laid out as `shardings` say.

    Arrays that every process holds itself are placed shard by shard: `device_put` would gather them from all processes
    to compare them.
    """
    if jax.process_count() == 1:
        return jax.device_put(tree, shardings)

    def put(x: Any, sharding: jax.sharding.Sharding) -> jax.Array:
        if isinstance(x, jax.Array) and not x.is_fully_addressable:
            return jax.device_put(x, sharding)
        return place(np.asarray(x), sharding)

    if isinstance(shardings, jax.sharding.Sharding):
        return jax.tree.map(lambda x: put(x, shardings), tree)
    return jax.tree.map(put, tree, shardings)
