"""Evaluates the tiny model on the mesh given as "data,fsdp,tensor" into a table of windows.

Prints the number of devices, and how many collectives inside of loops gather parameters. With a third argument
parameters stay as they are stored.
"""

import json
import sys
from pathlib import Path

import jax

from hma_jax.config import MeshConfig
from hma_jax.evaluation import evaluate as module
from hma_jax.runtime.sharding import GATHER
from tests.hma_jax.evaluation.fakes import evaluate_on


def main(mesh: str, path: str, stored: str = "") -> None:
    if stored:
        module.WHOLE = -1
    gathers = []

    def counted(name, function, *arguments):
        text = function.lower(*arguments).compile().as_text()
        gathers.append(sum(GATHER in line and line.count("while/body") >= 1 for line in text.splitlines()))
        return function

    module.compiled_by_all = counted
    evaluation, seen = evaluate_on(MeshConfig(*map(int, mesh.split(",")), min_shard_size=64), each=7, batch=5)
    assert seen == [5, 10, 14]
    assert evaluation.samples["arm"]["random"].shape == (1, 6, 8, 8, 3)
    evaluation.windows.save(Path(path), "model")
    print(json.dumps([jax.device_count(), *gathers]))


if __name__ == "__main__":
    main(*sys.argv[1:])
