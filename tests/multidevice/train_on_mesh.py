"""Trains a tiny model of ids or latents on the mesh given as "data,fsdp,tensor"; prints a JSON line."""

import json
import sys
from pathlib import Path

import jax

from hma_jax.config import DiffusionConfig, ExecutionConfig, MeshConfig
from hma_jax.training.loop import LoopOptions
from hma_jax.training.train import train_model
from tests.tiny import TABLE, batches, model_config, train_config

LATENTS = DiffusionConfig(channels=2, patch=1, width=64, depth=2, steps=20)


def main(mesh: str, run_dir: str, steps: str, kind: str) -> None:
    data, fsdp, tensor = map(int, mesh.split(","))
    # Action heads of so small a model are a large part of it, and have no axis that splits eight ways.
    model = model_config() if kind == "ids" else model_config(diffusion=LATENTS, action_heads=False)
    result = train_model(
        model,
        TABLE,
        train_config(steps=int(steps)),
        batches(model),
        run_dir=Path(run_dir),
        provenance={},
        execution=ExecutionConfig(mesh=MeshConfig(data, fsdp, tensor, min_shard_size=64)),
        options=LoopOptions(),
    )
    arrays = jax.tree.leaves(result.state.params)
    split = sum(x.size for x in arrays if not x.sharding.is_fully_replicated)
    print(
        json.dumps(
            {
                "losses": result.losses,
                "resumed_from": result.resumed_from,
                "split": split / sum(x.size for x in arrays),
            }
        )
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
