"""Trains a model of forty robots on several meshes of the devices at hand; prints a JSON line.

Arguments: the kind of model ("ids", "latents", "attended": ids, actions entering by cross-attention, "kept": ids,
nothing computed twice, or "recipe": latents with recall and Muon, as the continuous study has them), the number of
steps, the number of robots and the meshes, each as "data,fsdp,tensor".
"""

import json
import math
import sys
from dataclasses import replace

import jax

from hma_jax.config import DiffusionConfig, ExecutionConfig, MeshConfig, ModelConfig, OptimizerConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.runtime.mesh import make_mesh
from hma_jax.runtime.sharding import put_batch
from hma_jax.training.state import init_state, state_shapes
from hma_jax.training.step import make_train_step
from tests.tiny import model_config, random_batch, train_config

BATCH = 16
FAST = OptimizerConfig(learning_rate=3e-3, warmup_steps=2)  # so that losses show what parameters became
LATENTS = DiffusionConfig(channels=2, patch=1, width=32, depth=2, steps=20)


def make_table(robots: int) -> EmbodimentTable:
    """Robots of one to seven joints, one to three actions a frame."""
    return EmbodimentTable(
        tuple(
            Embodiment(f"robot_{i}", 1 + i % 7, 1 + i % 3, (0.1 * i,) * (1 + i % 7), (1.0,) * (1 + i % 7))
            for i in range(robots)
        )
    )


def make_model(kind: str) -> ModelConfig:
    """More layers than are written out one after the other (`model.trunk.MAX_UNROLLED_LAYERS`)."""
    changes = {
        "latents": {"diffusion": LATENTS},
        "recipe": {"diffusion": LATENTS, "recall": True},
        "attended": {"conditioning": "cross_attention"},
    }
    return model_config(width=32, heads=8, layers=5, frames=4, tokens=4, **changes.get(kind, {}))


def train(kind: str, mesh: tuple[int, int, int], steps: int, robots: int) -> dict:
    model, table = make_model(kind), make_table(robots)
    optimizer = replace(FAST, matrices="muon") if kind == "recipe" else FAST
    config = train_config(steps=steps, batch=BATCH, optimizer=optimizer)
    mesh_config = MeshConfig(*mesh, min_shard_size=1)
    execution = ExecutionConfig(remat="none" if kind == "kept" else "everything", mesh=mesh_config)
    declared = declare_model(model, table, execution)
    device_mesh = make_mesh(mesh_config, jax.devices()[: math.prod(mesh)])
    shapes = state_shapes(declared, table, device_mesh, mesh_config)
    with jax.set_mesh(device_mesh):
        step = jax.jit(
            make_train_step(declared, table, model, config),
            donate_argnums=0,
            out_shardings=(jax.tree.map(lambda x: x.sharding, shapes), None),
        )
        state, losses = init_state(declared, table, 0, shapes), []
        for number in range(steps):
            state, metrics = step(state, put_batch(random_batch(number % 2, model, BATCH, table), device_mesh))
            losses.append(float(metrics["loss"]))
    arrays = jax.tree.leaves((state.params, state.opt_state.first, state.opt_state.second))
    first = jax.devices()[0]
    here = sum(shard.data.nbytes for x in arrays for shard in x.addressable_shards if shard.device == first)
    return {"losses": losses, "bytes": sum(x.nbytes for x in arrays), "bytes_on_first": here}


def main(kind: str, steps: str, robots: str, *meshes: str) -> None:
    results = {mesh: train(kind, tuple(map(int, mesh.split(","))), int(steps), int(robots)) for mesh in meshes}
    print(json.dumps(results))


if __name__ == "__main__":
    main(*sys.argv[1:])
