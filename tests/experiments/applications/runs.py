"""A run of two of the suite's robots that has learnt nothing, its tokenizer beside it as in a study's directory."""

from __future__ import annotations

from pathlib import Path

from hma_jax.config import TrainConfig
from hma_jax.convert.run_directory import write_run
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.training.runs import Run
from tests.hma_jax.simulator.small import CONFIG, parts

TABLE = EmbodimentTable((
    Embodiment("pusher_sand", 2, 2, (0.0, 0.0), (2.0, 2.0)),
    Embodiment("gripper_wood", 4, 2, (0.5,) * 4, (0.2,) * 4),
))  # fmt: skip


def make_run(root: Path, train: TrainConfig = TrainConfig(), table: EmbodimentTable = TABLE) -> Path:
    """The run's directory, in `root`, said to be trained as `train`."""
    tokenizer = parts()[1]
    save_tokenizer(tokenizer, root / "tokenizer")
    params = declare_model(CONFIG, table).init(0)
    write_run(Run(CONFIG, train, table, params, 0, {"tokenizer": tokenizer.identity}), root / "model")
    return root / "model"
