"""A checkpoint of eight-way FSDP, restored on 2 x 4 devices, saved there and restored on one; prints a JSON line.

Argument: a directory. For each mesh: a digest of what was restored, and the logits that the mesh computes of it.
"""

import hashlib
import json
import math
import sys
from pathlib import Path

import jax
import numpy as np

from hma_jax.config import ExecutionConfig, MeshConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.mesh import make_mesh
from hma_jax.runtime.sharding import put_batch
from hma_jax.training.checkpoints import Checkpoints
from hma_jax.training.state import TrainState, init_state, state_shapes
from tests.multidevice.forty_robots import BATCH, make_model, make_table
from tests.tiny import random_batch

MESHES = ((1, 8, 1), (2, 4, 1), (1, 1, 1))


def digest(state: TrainState) -> str:
    arrays = [np.asarray(x).tobytes() for x in jax.tree.leaves(state)]
    return hashlib.sha256(b"".join(arrays)).hexdigest()


def main(directory: str) -> None:
    model, table = make_model("ids"), make_table(40)
    batch = random_batch(0, model, BATCH, table)
    state, few, found = None, None, []
    for number, sizes in enumerate(MESHES):
        config = MeshConfig(*sizes, min_shard_size=1)
        declared = declare_model(model, table, ExecutionConfig(mesh=config))
        mesh = make_mesh(config, jax.devices()[: math.prod(sizes)])
        shapes = state_shapes(declared, table, mesh, config)
        if state is None:
            state = init_state(declared, table, 0, shapes)
            # Away from their start, where the read-out is small and much is zero.
            moved = jax.tree.map(lambda x: x + 0.1 * np.cos(np.arange(x.size)).reshape(x.shape), state.params)
            state = state._replace(params=moved)
        else:
            with Checkpoints(Path(directory) / str(number - 1), {}) as checkpoints:
                _, state = checkpoints.restore(shapes)
        with Checkpoints(Path(directory) / str(number), {}) as checkpoints:
            checkpoints.save(1, state)
        # Of a run that trains two robots alone, with moments of these.
        some = state_shapes(declared, table, mesh, config, only=("robot_3", "robot_9"))
        if few is None:
            few = init_state(declared, table, 0, some)
            moved = jax.tree.map(lambda x: x + np.cos(np.arange(x.size)).reshape(x.shape), few.opt_state.first)
            few = few._replace(opt_state=few.opt_state._replace(first=moved))
        else:
            with Checkpoints(Path(directory) / f"few{number - 1}", {}) as checkpoints:
                _, few = checkpoints.restore(some)
        with Checkpoints(Path(directory) / f"few{number}", {}) as checkpoints:
            checkpoints.save(1, few)
        with jax.set_mesh(mesh):
            rows = put_batch(batch, mesh)
            apply = jax.jit(
                lambda p, b, d=declared: d.merge(p)(b["tokens"], None, b["actions"], b["embodiment"]).token_outputs
            )
            logits = np.asarray(apply(state.params, rows))
        split = [x for x in jax.tree.leaves(state.params) if not x.sharding.is_fully_replicated]
        found.append(
            {"state": digest(state), "few": digest(few), "logits": logits.ravel().tolist(), "split": len(split)}
        )
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
