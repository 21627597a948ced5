"""A study that has run, with the numbers of every window, from which its results follow; nothing is trained."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.running.ledger import Ledger
from experiments.running.result_file import write_result
from experiments.running.run_trial import write_samples
from experiments.running.trial import Trial
from experiments.running.workspace import Record, Workspace, save_record
from experiments.study import Study
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import unique_trials
from hma_jax.config import ModelConfig
from hma_jax.config.json import to_dict
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import FILE, WindowTable
from tests.experiments.fakes import PROVENANCE, RECORD, STUDY, result_of, samples_of

WIDE = replace(STUDY, widths=(8, 16, 24, 32, 48), seeds=(0, 1, 2))
"""Enough widths and seeds for a fit."""

EPISODES, WINDOWS = 6, 2
NOISE = 2e-3
"""Of seeds, in the logarithm of the loss."""


def judged_study(root: Path, study: Study = WIDE, axes: Sequence[str] = ("width",)) -> tuple[Workspace, Record]:
    """Every trial finished and sealed, the study recorded; ready to be drawn."""
    workspace, record = Workspace(root), Record(study, axes=tuple(axes), command="hma study", provenance=PROVENANCE)
    for id, trial in unique_trials(plan_sweeps(study, axes), PROVENANCE).items():
        finish(workspace, id, trial)
    save_record(workspace, record)
    return workspace, record


def finish(workspace: Workspace, id: str, trial: Trial) -> None:
    """What a finished trial leaves in its directory."""
    directory = workspace.trials / id
    directory.mkdir(parents=True)
    Ledger(workspace.ledger).append(id, "finished")
    job = {"trial": to_dict(trial), "provenance": to_dict(PROVENANCE), "execution": to_dict(WIDE.execution)}
    (directory / "job.json").write_text(json.dumps(job))
    (directory / "provenance.json").write_text(json.dumps(to_dict(RECORD)))
    windows = windows_of(trial)
    windows.save(directory / FILE, id)
    write_samples(directory / "samples.npz", samples_of(trial))
    first = math.log(trial.model.vocab_size)
    untrained = {"cross_entropy": {"mean": first, "sem": 0.0, "n": 2, "episodes": 2}}
    write_result(directory, result_of(trial) | {
        "evaluation": summarise(windows, trial.eval.perplexity_group).to_dict(),
        "untrained": dict.fromkeys(trial.evaluated, untrained) if trial.measure_untrained else None,
    })  # fmt: skip


def expected_loss(model: ModelConfig) -> float:
    """A power law in the trunk's parameters."""
    from experiments.analysis.scaling import trunk_parameters

    return 1.5 + (trunk_parameters(model) / 2e3) ** -0.5


def windows_of(trial: Trial) -> WindowTable:
    """Windows that are as hard in every trial, and a loss and a ΔPSNR that follow from width, seed and control."""
    own = np.random.default_rng(zlib.crc32(trial.title.encode()))
    loss = expected_loss(trial.model) * math.exp(NOISE * own.standard_normal())
    per_robot = EPISODES * WINDOWS
    count = per_robot * len(trial.evaluated)
    episode = np.tile(np.repeat(np.arange(EPISODES), WINDOWS), len(trial.evaluated))
    of_robots = [np.random.default_rng(zlib.crc32(name.encode())) for name in trial.evaluated]
    hard = np.concatenate([np.exp(0.2 * rng.standard_normal(per_robot)) for rng in of_robots])
    copy = np.concatenate([18 + rng.standard_normal(per_robot) for rng in of_robots])
    steers = np.repeat(np.linspace(0.0, 3.0, len(trial.evaluated)), per_robot) * (not trial.shuffle_actions)
    metrics = {
        "cross_entropy": loss * hard,
        "accuracy": np.full(count, 0.5),
        "psnr": copy + 2 + 0.3 * own.standard_normal(count),
        "psnr_copy": copy,
        "ssim": np.full(count, 0.8),
        "delta_psnr": steers + 0.3 * own.standard_normal(count),
    }
    metrics = {name: column.astype(np.float32).astype(np.float64) for name, column in metrics.items()}  # as judged
    names = np.repeat(np.array(trial.evaluated), per_robot)
    frames = np.full(count, trial.model.frames)
    return WindowTable(names, episode, np.tile(np.arange(WINDOWS), count // WINDOWS), frames, metrics)
