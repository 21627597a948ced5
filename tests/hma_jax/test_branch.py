"""Runs that differ in their number of steps alone: what they have in common, trained once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hma_jax.config import OptimizerConfig, TrainConfig
from hma_jax.training.branch import CHECKPOINTS, begin_from, last_step
from hma_jax.training.checkpoints import CheckpointError
from hma_jax.training.loop import LoopOptions
from hma_jax.training.optimizer import make_schedule, steps_in_common
from hma_jax.training.reading import list_steps
from hma_jax.training.train import train_model
from tests.hma_jax.test_training import equal_trees
from tests.tiny import SMALLER, TABLE, batches, model_config, train_config
from tests.written import record_writes

WSD = OptimizerConfig(learning_rate=1e-2, warmup_steps=1, schedule="wsd", decay_fraction=0.5)
MODEL = model_config(**SMALLER)


def train(run_dir: Path, steps: int, optimizer: OptimizerConfig = WSD, **options):
    config: TrainConfig = replace(train_config(optimizer=optimizer), steps=steps)
    return train_model(
        MODEL, TABLE, config, batches(MODEL), run_dir=run_dir, provenance={"data": "random"},
        options=LoopOptions(log_every=1, **options),
    )  # fmt: skip


@pytest.mark.parametrize("schedule", ["constant", "cosine", "wsd"])
@pytest.mark.parametrize(("fewer", "more"), [(100, 101), (100, 500), (40, 1000), (10, 20), (5, 20)])
def test_rates_agree_for_as_long_as_is_said_and_no_longer(schedule, fewer, more):
    config = OptimizerConfig(learning_rate=1e-3, warmup_steps=8, schedule=schedule)
    same = steps_in_common(config, fewer, more)
    assert same == steps_in_common(config, more, fewer)
    rates = [np.array([make_schedule(config, n)(step) for step in range(fewer)]) for n in (fewer, more)]
    end = int(min(same, fewer))
    np.testing.assert_array_equal(rates[0][:end], rates[1][:end])
    if schedule == "wsd" and fewer > 8:
        assert end == fewer - max(int(0.2 * fewer), 1) and rates[0][end + 1] != rates[1][end + 1]


def test_a_branch_is_byte_equal_to_a_run_of_its_own(tmp_path: Path):
    """The checkpoint before the decay stays, though the newest ones alone would be kept."""
    alone = train(tmp_path / "alone", 12)
    train(tmp_path / "short", 6, checkpoint_every=1, keep_checkpoints=1, keep_steps=(3,))
    assert list_steps(tmp_path / "short" / CHECKPOINTS) == [3, 6]
    assert begin_from(tmp_path / "short", tmp_path / "branch", 5) == 3
    branch = train(tmp_path / "branch", 12)
    assert branch.resumed_from == 3 and branch.losses == alone.losses
    assert equal_trees(branch.state, alone.state)
    logs = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("alone", "branch")]
    assert logs[0] == logs[1]
    assert begin_from(tmp_path / "short", tmp_path / "branch", 5) is None, "it has checkpoints of its own"


def test_a_branch_is_on_the_disk_before_its_checkpoint_is_seen(tmp_path: Path, monkeypatch):
    """Its logs first: a checkpoint without them, after a loss of power, is refused."""
    source, branch = tmp_path / "source", tmp_path / "branch"
    (source / CHECKPOINTS / "3").mkdir(parents=True)
    for name in (f"{CHECKPOINTS}/3/state", "metrics.jsonl"):
        (source / name).touch()
    branch.mkdir()
    done = record_writes(branch, monkeypatch)
    assert begin_from(source, branch, 5) == 3
    assert done == ["metrics.jsonl", "branch", "state", ".3.copied", "rename", CHECKPOINTS]


def test_a_run_does_not_go_on_from_where_another_had_begun_to_decay(tmp_path: Path):
    train(tmp_path / "short", 6)
    assert last_step(tmp_path / "short", 5) == 0
    assert begin_from(tmp_path / "short", tmp_path / "branch", 6) == 6
    with pytest.raises(CheckpointError, match="train.steps: 6 -> 12"):
        train(tmp_path / "branch", 12)
