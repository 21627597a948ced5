"""job.json: what a trial's process is told, also by earlier versions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.presets import SMOKE
from experiments.running.job import read_job
from experiments.running.migration import migrate
from experiments.running.shared_runs import SharedTraining
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import ConfigError, EvalConfig, ExecutionConfig, MeshConfig
from hma_jax.config.json import to_dict

OLD = Path(__file__).parent / "data" / "job_3caafdd.json"
"""The reference trial of the smoke study as commit 3caafdd wrote it, in bfloat16, without remat, in two
micro-batches, on a mesh of fsdp 2."""


def test_a_job_says_the_trial_and_how_it_is_computed():
    trial, execution = reference_trial(SMOKE, 1), ExecutionConfig(dtype="bfloat16", remat="none")
    record = json.loads(json.dumps({"trial": to_dict(trial), "provenance": {}, "execution": to_dict(execution)}))
    assert read_job(record) == (trial, execution, SharedTraining())
    shared = SharedTraining((("abc", 800),), keep=(1600,))
    assert read_job(json.loads(json.dumps(record | {"shared": to_dict(shared)})))[2] == shared


def test_a_job_of_an_earlier_version_is_the_same_trial_and_how_it_was_computed_is_kept():
    trial, execution, shared = read_job(json.loads(OLD.read_text()))
    data = {"datasets": trial.datasets, "evaluated": trial.evaluated}  # robots of the suite's first edition
    judged = replace(SMOKE.eval, other_actions=EvalConfig().other_actions)  # which it does not name
    assert trial == replace(reference_trial(SMOKE, 0), model=trial.model, train=trial.train, eval=judged, **data)
    assert (trial.model.width, trial.train.steps) == (SMOKE.model.width, SMOKE.train.steps)
    assert shared == SharedTraining()
    assert execution == ExecutionConfig("bfloat16", "products", "auto", accumulate=2, mesh=MeshConfig(fsdp=2))


def test_fields_of_earlier_versions_are_read_as_what_they_are_called_today():
    before = {"model": {"remat": True, "width": 8}, "train": {"accumulate": 2}, "eval": {"unmask_steps": 7, "seed": 1}}
    today, execution = migrate(before)
    assert today == {"model": {"width": 8}, "train": {}, "eval": {"decode": {"unmask_steps": 7}, "seed": 1}}
    assert execution == {"remat": "everything", "accumulate": 2} and before["eval"]["unmask_steps"] == 7


def test_what_is_no_job_is_refused_by_words():
    with pytest.raises(ConfigError, match="not a job of this project .*; run its study again"):
        read_job({"steps": 3})
    record = json.loads(OLD.read_text())
    record["trial"]["model"]["telepathy"] = True
    with pytest.raises(ConfigError, match=r"unknown field\(s\) telepathy"):
        read_job(record)
