"""What eight devices send each other for the gradient of one product's weight, and for Muon; prints a JSON line.

Of each of the two ("product", "muon") it says how often each kind of communication stands in the program, and of
one device the FLOPs and the bytes of temporary arrays; of Muon also by how much its result is off that of one device.
"""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.bench.collectives import count_kinds, find_collectives
from hma_jax.config import MeshConfig
from hma_jax.kernels.dense import contract
from hma_jax.model.params import ParamSpec, zeros
from hma_jax.runtime.mesh import make_mesh
from hma_jax.training.optimizer import muon_direction

WIDTH, HEADS, HEAD = 64, 8, 8
SPEC = ParamSpec((4, 6, WIDTH, 2 * WIDTH), ("N", "E", "D", "D_out"), "hidden", True, zeros)


def of_product() -> dict[str, Any]:
    """Of the gradient of the weight of queries, keys and values, whose heads are split."""
    mesh = make_mesh(MeshConfig(2, 1, 4))
    rows, heads = NamedSharding(mesh, PartitionSpec("data")), NamedSharding(mesh, PartitionSpec(None, None, "tensor"))
    x = jax.ShapeDtypeStruct((4, 120, WIDTH), jnp.float32, sharding=rows)
    w = jax.ShapeDtypeStruct((WIDTH, 3, HEADS, HEAD), jnp.float32, sharding=heads)
    with jax.set_mesh(mesh):
        gradient = jax.jit(jax.grad(lambda w, x: jnp.sum(contract(x, w) ** 2)), out_shardings=heads)
        return describe(gradient.lower(w, x).compile(), mesh)


def of_muon() -> dict[str, Any]:
    """Of a parameter of 24 matrices that every axis of the mesh could split."""
    mesh = make_mesh(MeshConfig(2, 2, 2))
    momentum = np.random.default_rng(0).normal(size=SPEC.shape).astype(np.float32)
    layout = NamedSharding(mesh, PartitionSpec(None, None, "fsdp", "tensor"))
    one = jax.jit(lambda x: muon_direction(x, SPEC, 1.0, min_shard_size=2**14))(momentum)
    with jax.set_mesh(mesh):
        stored = jax.device_put(momentum, layout)
        compiled = (
            jax.jit(lambda x: muon_direction(x, SPEC, 1.0, min_shard_size=2**14), out_shardings=layout)
            .lower(stored)
            .compile()
        )
        off = np.abs(np.asarray(compiled(stored)) - np.asarray(one)).max()
        return describe(compiled, mesh) | {"off": float(off)}


def describe(compiled: jax.stages.Compiled, mesh: Mesh) -> dict[str, Any]:
    return {
        "kinds": count_kinds(find_collectives(compiled.as_text(), mesh.shape)),
        "temporary": compiled.memory_analysis().temp_size_in_bytes,
        "flops": compiled.cost_analysis()["flops"],
    }


if __name__ == "__main__":
    print(json.dumps({"product": of_product(), "muon": of_muon()}))
