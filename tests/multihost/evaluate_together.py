"""Evaluates the tiny model in as many processes as the environment says; process 0 writes the table of windows."""

import os
import sys
from pathlib import Path

import numpy as np

from hma_jax.config import MeshConfig
from hma_jax.runtime.processes import Processes, end, is_writer, start
from tests.hma_jax.evaluation.fakes import evaluate_on


def main(path: str) -> None:
    start(Processes().or_from(os.environ))
    evaluation, seen = evaluate_on(MeshConfig(-1, 1, 1, min_shard_size=64), each=3, batch=4)
    assert seen[-1] == len(evaluation.windows) == 6
    if is_writer():
        evaluation.windows.save(Path(path), "model")
        np.savez(path + ".npz", **evaluation.samples["arm"])
    end()


if __name__ == "__main__":
    main(*sys.argv[1:])
