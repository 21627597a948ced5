"""The metrics of the first training steps of two tiny models, on record in first_steps.json.

`python -m tests.golden.first_steps` writes the record anew: after a change that is meant to alter them, and no other.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from hma_jax.training.train import train_model
from tests.tiny import DIFFUSION, SMALLER, TABLE, batches, model_config, train_config

RECORD = Path(__file__).with_name("first_steps.json")
COMMAND = "python -m tests.golden.first_steps"
MODELS = {"ids": model_config(**SMALLER), "latents": model_config(**SMALLER, diffusion=DIFFUSION)}
STEPS, BATCH = 3, 4


def first_steps(name: str, run_dir: Path) -> list[dict[str, float]]:
    """Metrics of the steps 1 to STEPS, by training in `run_dir`."""
    model, config = MODELS[name], train_config(steps=STEPS, batch=BATCH)
    train_model(model, TABLE, config, batches(model, BATCH), run_dir=run_dir, provenance={})
    return [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        found = {name: first_steps(name, Path(folder) / name) for name in MODELS}
    RECORD.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
