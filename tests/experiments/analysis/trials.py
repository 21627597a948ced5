"""Finished trials on disk, without running any."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from experiments.running.result_file import write_result
from experiments.running.run_trial import last_loss
from experiments.running.trial import Trial, trial_id
from hma_jax.config import ExecutionConfig
from hma_jax.config.json import to_dict
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import FILE, WindowTable
from tests.experiments.fakes import PROVENANCE


def write_trial(trials: Path, trial: Trial, windows: WindowTable, provenance=PROVENANCE) -> Path:
    """Its directory, as `run_trial` leaves it, less its clips and checkpoints."""
    directory = trials / trial_id(trial, provenance)
    directory.mkdir(parents=True)
    (directory / "job.json").write_text(json.dumps({"trial": to_dict(trial), "provenance": to_dict(provenance),
                                                    "execution": to_dict(ExecutionConfig())}))  # fmt: skip
    windows.save(directory / FILE, directory.name)
    evaluation = summarise(windows, trial.eval.perplexity_group).to_dict()
    result = {
        "evaluation": evaluation,
        "untrained": None,
        "training_loss": last_loss([3.0, 2.0]),
        "parameters": 10,
        "train_flops": 1e9,
    }
    write_result(directory, result)
    return directory


def as_stored(windows: WindowTable) -> WindowTable:
    """With the float32 that a file keeps."""
    metrics = {name: x.astype(np.float32).astype(np.float64) for name, x in windows.metrics.items()}
    return WindowTable(windows.dataset, windows.episode, windows.start, windows.frames, metrics)
