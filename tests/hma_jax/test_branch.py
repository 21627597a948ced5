"""Runs that differ in their number of steps alone: what they have in common, trained once."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hma_jax.config import ConfigError, OptimizerConfig, TrainConfig
from hma_jax.training.branch import CHECKPOINTS, FILE, begin_from, branch, last_step
from hma_jax.training.checkpoints import CheckpointError
from hma_jax.training.loop import LoopOptions
from hma_jax.training.optimizer import make_schedule, steps_in_common
from hma_jax.training.reading import list_steps
from hma_jax.training.runs import load_run
from hma_jax.training.train import train_model
from tests.hma_jax.test_training import equal_trees
from tests.tiny import SMALLER, TABLE, batches, model_config, train_config
from tests.written import record_writes

WSD = OptimizerConfig(learning_rate=1e-2, warmup_steps=1, schedule="wsd", decay_fraction=0.5)
MODEL = model_config(**SMALLER)


def train(run_dir: Path, steps: int, optimizer: OptimizerConfig = WSD, model=MODEL, **options):
    config: TrainConfig = replace(train_config(optimizer=optimizer), steps=steps)
    return train_model(
        model, TABLE, config, batches(model), run_dir=run_dir, provenance={"data": "random"},
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
    train(tmp_path / "short", 6, keep_checkpoints=1, keep_steps=(3,))
    assert list_steps(tmp_path / "short" / CHECKPOINTS) == [3, 6]
    assert begin_from(tmp_path / "short", tmp_path / "branch", 5) == 3
    branch = train(tmp_path / "branch", 12)
    assert branch.resumed_from == 3 and branch.losses == alone.losses
    assert equal_trees(branch.state, alone.state)
    logs = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("alone", "branch")]
    assert logs[0] == logs[1]
    assert begin_from(tmp_path / "short", tmp_path / "branch", 5) is None, "it has checkpoints of its own"


def test_a_branch_is_on_the_disk_before_its_checkpoint_is_seen(tmp_path: Path, monkeypatch):
    """Its logs first, all of them: a checkpoint without them, after a loss of power, is refused."""
    source, branch = tmp_path / "source", tmp_path / "branch"
    (source / CHECKPOINTS / "3").mkdir(parents=True)
    logs = ["metrics.jsonl", "validation.jsonl", "timing.jsonl"]
    for name in (f"{CHECKPOINTS}/3/state", *logs):
        (source / name).write_text(name)
    branch.mkdir()
    done = record_writes(branch, monkeypatch)
    assert begin_from(source, branch, 5) == 3
    assert done == [*logs, "branch", "state", ".3.copied", "rename", CHECKPOINTS]
    assert [(branch / name).read_text() for name in logs] == logs


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of six steps, saved at its end."""
    run_dir = tmp_path_factory.mktemp("runs") / "short"
    train(run_dir, 6)
    return run_dir


def test_a_run_does_not_go_on_from_where_another_had_begun_to_decay(short: Path, tmp_path: Path):
    assert last_step(short, 5) == 0
    assert begin_from(short, tmp_path / "branch", 6) == 6
    with pytest.raises(CheckpointError, match="train.steps: 6 -> 12"):
        train(tmp_path / "branch", 12)


def test_a_branch_goes_on_with_another_optimiser_and_order_of_data_and_remembers_it(tmp_path: Path):
    source, new, slower = tmp_path / "source", tmp_path / "new", replace(WSD, learning_rate=1e-3, schedule="constant")
    train(source, 6, keep_every=2)
    assert branch(source, new, 2) == 2 and list_steps(new / CHECKPOINTS) == [2]
    with pytest.raises(CheckpointError, match="model.width"):
        train(new, 12, slower, model=replace(MODEL, width=2 * MODEL.width))
    first = train(new, 4, slower)
    assert first.resumed_from == 2 and list_steps(new / CHECKPOINTS) == [2, 4]
    logs = [(tmp_path / name / "metrics.jsonl").read_text().split("\n") for name in ("source", "new")]
    assert logs[1][:2] == logs[0][:2] and logs[1][2] != logs[0][2]
    (was,) = load_run(new).provenance["branched"]
    assert was["step"] == 2 and was["train"]["optimizer"]["learning_rate"] == WSD.learning_rate
    assert train(new, 8, slower).resumed_from == 4, "from its own checkpoint, which knows of the branching"
    with pytest.raises(CheckpointError, match="train.optimizer.learning_rate"):
        train(new, 8)
    branch(new, tmp_path / "again", 8)
    assert train(tmp_path / "again", 12).resumed_from == 8
    assert [b["step"] for b in load_run(tmp_path / "again").provenance["branched"]] == [2, 8]


def test_what_cannot_be_branched(tmp_path: Path):
    source, new = tmp_path / "source", tmp_path / "new"
    with pytest.raises(ConfigError, match="has no checkpoint; give"):
        branch(source, new)
    train(source, 6, keep_every=3)
    with pytest.raises(ConfigError, match="no checkpoint of step 2; it has those of 3, 6. .*keep-every"):
        branch(source, new, 2)
    shutil.copytree(source / CHECKPOINTS / "6", tmp_path / "converted" / CHECKPOINTS / "0")
    with pytest.raises(ConfigError, match="was converted, .* `hma train --from`"):
        branch(tmp_path / "converted", new)
    assert not new.exists()
    assert branch(source, new) == 6
    with pytest.raises(ConfigError, match="is a run already"):
        branch(source, new)
    shutil.rmtree(new / CHECKPOINTS)
    with pytest.raises(ConfigError, match="branch again"):
        train(new, 12)
    assert (new / FILE).exists() and branch(source, new, 3) == 3, "one that was cut short is made again"


def test_a_relative_path_is_branched_without_warnings(short: Path, tmp_path: Path, monkeypatch, caplog):
    """Orbax warns of paths that are not absolute, once for every item."""
    monkeypatch.chdir(short.parent)
    caplog.clear()
    assert branch(Path("short"), Path("new")) == 6 and not caplog.records
