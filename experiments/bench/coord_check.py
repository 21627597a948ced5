"""The coordinate check of muP for a study's model: what is trained for it, and its table.

The measuring and the judging are in `hma_jax.diagnostics.coordinate_check`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from experiments.bench.models import make_table, random_batch
from experiments.study import Study
from experiments.tables import write_table
from experiments.terminal.progress import Update
from hma_jax.config import MaskingConfig, ModelConfig, OptimizerConfig, TrainConfig, require
from hma_jax.diagnostics.coordinate_check import Size, measure

FRAMES, TOKENS = 3, 16
"""Largest window, in frames and tokens per frame. A short window shows the same powers of the width."""

BATCH = 4
"""Windows, which the models learn by heart."""

FACTORS = (1, 2, 4, 8)
"""Widths by default, as multiples of the base width."""


def choose_widths(model: ModelConfig, widths: Sequence[int]) -> tuple[int, ...]:
    """`widths`, by default FACTORS times the base width, in ascending order. Raises ConfigError if there are fewer than
    two, and for widths that the model cannot have."""
    chosen = tuple(sorted(set(widths or [factor * model.mup.base_width for factor in FACTORS])))
    require(len(chosen) > 1, f"--widths must be at least two different widths, got {' '.join(map(str, widths))}")
    for width in chosen:
        replace(model, width=width)
    return chosen


def measure_widths(
    study: Study,
    widths: Sequence[int],
    steps: int,
    seeds: int,
    learning_rate: float,
    report: Update = lambda done, total, note: None,
) -> list[Size]:
    """The sizes of activations of the study's model at `widths`, with its optimiser and its setting of masking. Windows
    are short and random, of one robot. `report` is called with (widths that are done, all of them, the next)."""
    model = replace(study.model, frames=min(study.model.frames, FRAMES), tokens=min(study.model.tokens, TOKENS))
    train = TrainConfig(
        steps=steps,
        batch=BATCH,
        seed=study.train.seed,
        optimizer=OptimizerConfig(
            learning_rate=learning_rate, warmup_steps=0, weight_decay=0.0, matrices=study.train.optimizer.matrices
        ),
        masking=MaskingConfig(setting=study.train.masking.setting, prompt_frames=1),
    )
    table = make_table(1)
    batch, rows = random_batch(model, table, BATCH), []
    for done, width in enumerate(widths):
        report(done, len(widths), f"width {width}")
        rows += measure(model, train, table, batch, [width], range(seeds))
    return rows


def write_sizes(path: Path, rows: Sequence[Size]) -> None:
    """One row for each activation, width, seed and step."""
    write_table(path, Size._fields, rows)
