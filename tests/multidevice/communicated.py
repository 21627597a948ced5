"""What devices send each other for the gradient of one product's weight; prints a JSON line.

It says how often each kind of communication stands in the program, and how many bytes of a device it needs for
temporary arrays.
"""

import json

import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec

from experiments.bench.collectives import count_kinds, find_collectives
from hma_jax.config import MeshConfig
from hma_jax.kernels.dense import contract
from hma_jax.runtime.mesh import make_mesh

BATCH, ROWS, WIDTH, HEADS, HEAD = 4, 120, 64, 8, 8


def compile_product(mesh: jax.sharding.Mesh) -> jax.stages.Compiled:
    """Of the gradient of the weight of queries, keys and values, whose heads are split."""
    rows, heads = NamedSharding(mesh, PartitionSpec("data")), NamedSharding(mesh, PartitionSpec(None, None, "tensor"))
    x = jax.ShapeDtypeStruct((BATCH, ROWS, WIDTH), jnp.float32, sharding=rows)
    w = jax.ShapeDtypeStruct((WIDTH, 3, HEADS, HEAD), jnp.float32, sharding=heads)
    gradient = jax.jit(jax.grad(lambda w, x: jnp.sum(contract(x, w) ** 2)), out_shardings=heads)
    return gradient.lower(w, x).compile()


def main() -> None:
    mesh = make_mesh(MeshConfig(2, 1, 4))
    with jax.set_mesh(mesh):
        compiled = compile_product(mesh)
    kinds = count_kinds(find_collectives(compiled.as_text(), mesh.shape))
    print(json.dumps({"kinds": kinds, "temporary": compiled.memory_analysis().temp_size_in_bytes}))


if __name__ == "__main__":
    main()
