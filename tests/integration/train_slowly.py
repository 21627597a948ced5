"""Trains the tiny model, a pause per step, announcing each; a parent process kills it."""

import sys
import time
from pathlib import Path

from hma_jax.training.loop import LoopOptions
from hma_jax.training.train import train_model
from tests.tiny import SMALLER, TABLE, batches, model_config, train_config


def announce(step: int, steps: int, metrics: dict) -> None:
    print(step, flush=True)
    time.sleep(0.05)


def train(run_dir: Path) -> None:
    model = model_config(**SMALLER)
    train_model(
        model,
        TABLE,
        train_config(steps=12),
        batches(model),
        run_dir=run_dir,
        provenance={},
        options=LoopOptions(checkpoint_every=3, log_every=1),
        progress=announce,
    )


if __name__ == "__main__":
    train(Path(sys.argv[1]))
