"""Trains a tiny model in as many processes as the environment says; each prints one line of JSON last.

    python -m tests.multihost.train_together RUN_DIR '{"steps": 5, "mesh": [-1, 1, 1], ...}'

Ends as `hma train` does, with its exit codes. With HMA_TESTS_FLOAT64=1 it computes in float64 what is float32
otherwise, so that nothing is left to tell two orders of summing apart.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

FLOAT64 = os.environ.get("HMA_TESTS_FLOAT64") == "1"
if FLOAT64:  # before the first module of the library says what its arrays are made of
    jax.config.update("jax_enable_x64", True)
    jnp.float32, np.float32 = jnp.float64, np.float64

from hma_jax.config import ExecutionConfig, MeshConfig
from hma_jax.runtime.processes import Processes, end, is_writer, start
from hma_jax.runtime.rows import own_rows
from hma_jax.training import hashes
from hma_jax.training.loop import Interrupted, LoopOptions
from hma_jax.training.train import train_model
from hma_jax.training.validation import Validation
from tests.tiny import TABLE, in_float64, model_config, random_batch, train_config


def main(run_dir: str, text: str) -> None:
    asked = {"mesh": [-1, 1, 1], "steps": 5, "every": 0, "pause": 0.0, "lost_after": 120.0, "ema": 0.0, "minutes": 0.0}
    asked |= json.loads(text)
    start(Processes(lost_after=asked["lost_after"], start_timeout=120).or_from(os.environ))
    try:
        report = train(Path(run_dir), asked)
    except Interrupted as stopped:
        end()
        print(stopped)
        sys.exit(stopped.exit)
    except BaseException as error:
        print(f"{type(error).__name__}: {error}")
        end(error, 1)
        raise
    print(json.dumps(report), flush=True)
    end()


def train(run_dir: Path, asked: dict[str, Any]) -> dict[str, Any]:
    # Without action heads, of which a model so small has too many to be split.
    model, config = model_config(action_heads=False), train_config(steps=asked["steps"], ema_decay=asked["ema"])
    mesh = MeshConfig(*asked["mesh"], min_shard_size=64)
    execution = ExecutionConfig(mesh=mesh)
    rows, seen, hashed, sha256 = own_rows(mesh, config.batch), [], [], hashes.hash_file

    def record(path: Path) -> str:
        hashed.append(path.as_posix())
        return sha256(path)

    hashes.hash_file = record

    def own(step: int) -> dict[str, np.ndarray]:
        return {name: x[rows] for name, x in random_batch(step, model, config.batch).items()}

    def batches(first: int) -> Iterator[dict[str, np.ndarray]]:
        for step in range(first, asked["steps"]):
            seen.append([digest(own(step), row) for row in range(len(rows))])
            yield own(step)

    def announce(step: int, steps: int, metrics: dict[str, float]) -> None:
        if asked["pause"]:
            print(f"step {step}", flush=True)
            time.sleep(asked["pause"])

    result = train_model(
        model, TABLE, config, batches, run_dir=run_dir, provenance={},
        execution=in_float64(execution) if FLOAT64 else execution,
        options=LoopOptions(checkpoint_every=asked["every"], checkpoint_minutes=asked["minutes"], log_every=2),
        validation=Validation(2, lambda: map(own, range(100, 103))) if asked.get("validate") else None,
        progress=announce,
    )  # fmt: skip
    return {
        "writer": is_writer(),
        "rows": rows.tolist(),
        "batches": seen,
        "losses": result.losses,
        "resumed_from": result.resumed_from,
        "hashed": hashed,
        "devices": jax.device_count(),
    }


def digest(batch: dict[str, np.ndarray], row: int) -> str:
    return hashlib.sha256(b"".join(batch[name][row].tobytes() for name in sorted(batch))).hexdigest()[:12]


if __name__ == "__main__":
    main(*sys.argv[1:])
