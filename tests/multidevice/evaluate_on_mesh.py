"""Evaluates the tiny model on the mesh given as "data,fsdp,tensor" into a table of windows."""

import sys
from pathlib import Path

import jax

from hma_jax.config import MeshConfig
from tests.hma_jax.evaluation.fakes import evaluate_on


def main(mesh: str, path: str) -> None:
    evaluation, seen = evaluate_on(MeshConfig(*map(int, mesh.split(",")), min_shard_size=64), each=7, batch=5)
    assert seen == [5, 10, 14]
    assert evaluation.samples["arm"]["random"].shape == (1, 6, 8, 8, 3)
    evaluation.windows.save(Path(path), "model")
    print(jax.device_count())


if __name__ == "__main__":
    main(*sys.argv[1:])
