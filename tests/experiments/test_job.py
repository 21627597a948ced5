"""job.json: what a trial's process is told."""

from __future__ import annotations

import json

import pytest

from experiments.presets import SMOKE
from experiments.running.job import read_job
from experiments.running.shared_runs import SharedTraining
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.config.json import to_dict


def test_a_job_says_the_trial_and_how_it_is_computed():
    trial, execution = reference_trial(SMOKE, 1), ExecutionConfig(dtype="bfloat16", remat="none")
    record = json.loads(json.dumps({"trial": to_dict(trial), "provenance": {}, "execution": to_dict(execution)}))
    assert read_job(record) == (trial, execution, SharedTraining())
    shared = SharedTraining((("abc", 800),), keep=(1600,))
    assert read_job(json.loads(json.dumps(record | {"shared": to_dict(shared)})))[2] == shared


def test_what_is_no_job_is_refused_by_words():
    with pytest.raises(ConfigError, match="not a job of this project .*; run its study again"):
        read_job({"steps": 3})
    record = {"trial": to_dict(reference_trial(SMOKE, 1)), "execution": to_dict(ExecutionConfig())}
    record["trial"]["model"]["telepathy"] = True
    with pytest.raises(ConfigError, match=r"unknown field\(s\) telepathy"):
        read_job(record)
