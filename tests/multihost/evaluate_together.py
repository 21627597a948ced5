"""Evaluates the tiny model in as many processes as the environment says; process 0 writes the table of windows."""

import os
import sys
from pathlib import Path

import numpy as np

from hma_jax.config import DecodeConfig, EvalConfig, ExecutionConfig, MeshConfig
from hma_jax.evaluation.evaluate import evaluate
from hma_jax.runtime.processes import Processes, end, is_writer, start
from tests.hma_jax.evaluation.fakes import GreyTokenizer, make_batches
from tests.tiny import TABLE, lively_params, model_config


def main(path: str) -> None:
    start(Processes().or_from(os.environ))
    config, seen = model_config(), []
    evaluation = evaluate(
        lively_params(config)[1],
        config,
        TABLE,
        GreyTokenizer(piece=3),
        make_batches(config, names=("base", "arm"), each=3, batch=4),
        EvalConfig(prompt_frames=2, random_actions=2, decode=DecodeConfig(2, temperature=0.5)),
        execution=ExecutionConfig(windows_at_once=1, mesh=MeshConfig(-1, 1, 1, min_shard_size=64)),
        progress=seen.append,
    )
    assert seen[-1] == len(evaluation.windows) == 6
    if is_writer():
        evaluation.windows.save(Path(path), "model")
        np.savez(path + ".npz", **evaluation.samples["arm"])
    end()


if __name__ == "__main__":
    main(*sys.argv[1:])
