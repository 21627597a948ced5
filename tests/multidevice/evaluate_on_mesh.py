"""Evaluates the tiny model on the mesh given as "data,fsdp,tensor" into a table of windows."""

import sys
from pathlib import Path

import jax

from hma_jax.config import DecodeConfig, EvalConfig, ExecutionConfig, MeshConfig
from hma_jax.evaluation.evaluate import evaluate
from tests.hma_jax.evaluation.fakes import GreyTokenizer, make_batches
from tests.tiny import TABLE, lively_params, model_config


def main(mesh: str, path: str) -> None:
    data, fsdp, tensor = map(int, mesh.split(","))
    config, seen = model_config(), []
    evaluation = evaluate(
        lively_params(config)[1],
        config,
        TABLE,
        GreyTokenizer(piece=3),
        make_batches(config, names=("base", "arm"), each=7, batch=5),
        EvalConfig(prompt_frames=2, random_actions=2, decode=DecodeConfig(2, temperature=0.5)),
        execution=ExecutionConfig(windows_at_once=1, mesh=MeshConfig(data, fsdp, tensor, min_shard_size=64)),
        progress=seen.append,
    )
    assert seen == [5, 10, 14]
    assert evaluation.samples["arm"]["random"].shape == (1, 6, 8, 8, 3)
    evaluation.windows.save(Path(path), "model")
    print(jax.device_count())


if __name__ == "__main__":
    main(*sys.argv[1:])
