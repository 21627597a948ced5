"""Trains a tiny model on the mesh given as "data,fsdp,tensor"; prints a JSON line."""

import json
import sys
from pathlib import Path

import jax

from hma_jax.config import ExecutionConfig, MeshConfig
from hma_jax.training.loop import LoopOptions
from hma_jax.training.train import train_model
from tests.tiny import TABLE, batches, model_config, train_config


def main(mesh: str, run_dir: str, steps: str) -> None:
    data, fsdp, tensor = map(int, mesh.split(","))
    model = model_config()
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
