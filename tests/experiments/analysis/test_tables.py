"""Finished trials as tables: what was written, nothing that was changed, and every setting."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from experiments.analysis.tables import read_trial, read_trials
from experiments.analysis.trials import trial_row, write_trials
from experiments.running.result_file import read_result
from experiments.running.trial import trial_id
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import ConfigError
from hma_jax.evaluation.windows import FILE
from tests.experiments.analysis.trials import as_stored, write_trial
from tests.experiments.analysis.worlds import judged, with_loss
from tests.experiments.fakes import PROVENANCE, STUDY


def two_seeds(tmp_path):
    table = judged(np.random.default_rng(0), robots=2)
    trials = [reference_trial(STUDY, seed) for seed in (0, 1)]
    tables = [table, with_loss(table, table.metrics["cross_entropy"] + 1)]
    return [write_trial(tmp_path, *pair) for pair in zip(trials, tables, strict=True)], tables


def test_finished_trials_come_back_with_every_window(tmp_path):
    directories, tables = two_seeds(tmp_path)
    (tmp_path / "unfinished").mkdir()
    found = read_trials(str(tmp_path))
    assert sorted(found) == list(found) == sorted(d.name for d in directories)
    for directory, table in zip(directories, tables, strict=True):
        one = found[directory.name]
        assert one.windows.names == table.names and one.provenance == PROVENANCE
        np.testing.assert_array_equal(one.windows.metrics["cross_entropy"], as_stored(table).metrics["cross_entropy"])
    assert sorted(one.seed for one in found.values()) == [0, 1]
    assert read_trials(tmp_path, ["unfinished", directories[0].name]).keys() == {directories[0].name}


def test_one_digit_of_the_windows_of_a_trial_cannot_be_changed(tmp_path):
    (directory, _), (table, _) = two_seeds(tmp_path)
    loss = table.metrics["cross_entropy"].copy()
    loss[3] += 0.001
    with_loss(table, loss).save(directory / FILE, directory.name)
    with pytest.raises(ConfigError, match=f"{FILE} was changed"):
        read_trial(directory)
    with pytest.raises(ConfigError, match="not a finished trial"):
        read_trial(tmp_path)
    (directory / FILE).unlink()
    with pytest.raises(ConfigError, match=f"{FILE} is missing"):
        read_trial(directory)


@pytest.mark.parametrize("job", ["", "null", "[]", "{}", '{"trial": 3, "provenance": {}}'])
def test_a_trial_that_does_not_say_what_it_is_is_named(tmp_path, job):
    (directory, _), _ = two_seeds(tmp_path)
    (directory / "job.json").write_text(job)
    with pytest.raises(
        ConfigError, match=f"{directory}: the description of the finished trial cannot be read .*; copy the trial again"
    ):
        read_trial(directory)


def test_a_row_per_trial_has_every_setting_and_result(tmp_path):
    (directory, _), (table, _) = two_seeds(tmp_path)
    trial = reference_trial(STUDY, 0)
    other = replace(trial, max_trajectories=None)
    there = {"arm": 3, "rover": 20, "pusher": 8}
    rows = [
        trial_row(directory.name, "a", "finished", trial, PROVENANCE, read_result(directory), there),
        trial_row(trial_id(other, PROVENANCE), "b", "failed", other, PROVENANCE, None, there),
    ]
    write_trials(tmp_path / "trials.parquet", rows)
    before = (tmp_path / "trials.parquet").read_bytes()
    write_trials(tmp_path / "trials.parquet", rows)
    assert (tmp_path / "trials.parquet").read_bytes() == before
    one, two = pq.read_table(tmp_path / "trials.parquet").to_pylist()
    assert one["config.train.optimizer.learning_rate"] == trial.train.optimizer.learning_rate
    assert one["config.datasets"] == '["arm", "rover", "pusher"]'
    assert (one["config.max_trajectories"], two["config.max_trajectories"]) == (8, None)
    assert (one["manifest"], one["robots"], one["windows"], one["training_loss"]) == (PROVENANCE.manifest, 2, 96, 2.0)
    assert one["cross_entropy"] == pytest.approx(table.metrics["cross_entropy"].mean(), rel=1e-6)
    assert (one["trajectories"], two["trajectories"]) == (3 + 8 + 8, 3 + 20 + 8)
    assert one["windows_drawn"] == trial.train.steps * trial.train.batch
    poor = trial_row("c", "c", "failed", replace(trial, capped=("rover",)), PROVENANCE, None, {**there, "arm": 30})
    assert poor["trajectories"] == 30 + 8 + 8
    assert trial_row("d", "d", "failed", trial, PROVENANCE, None, {})["trajectories"] is None
    short = read_result(directory) | {"trajectories": {"arm": 2, "rover": 5, "pusher": 8}}  # the others were damaged
    assert trial_row("e", "e", "finished", trial, PROVENANCE, short, there)["trajectories"] == 2 + 5 + 8
    assert two["status"] == "failed" and two["cross_entropy"] is two["parameters"] is None
