"""A study that has run, without running it: results on disk as `run_trial` leaves them."""

import json
import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.commands import AXES
from experiments.ledger import Ledger
from experiments.presets import SMOKE
from experiments.provenance import Provenance
from experiments.study import Study
from experiments.sweep import unique_trials
from experiments.trial import Trial, write_samples
from experiments.workspace import Record, Workspace

PROVENANCE = Provenance(store="5708e", manifest="3a41f", tokenizer="70c3", code="c0de")
STUDY = replace(
    SMOKE,
    datasets=("arm", "rover", "pusher"),
    dataset_counts=(2, 3),
    trajectory_counts=(2, 4, 8),
    widths=(8, 16),
    seeds=(0, 1),
)


def finished_study(root: Path, study: Study = STUDY, broken: dict[str, str] | None = None) -> Workspace:
    """A workspace with a result for every trial, but a failure for titles that contain a key of
    `broken` (its value is the state). Ready for `commands.draw`."""
    workspace = Workspace(root)
    ledger = Ledger(workspace.ledger)
    for id, trial in unique_trials([plan(study) for plan in AXES.values()], PROVENANCE).items():
        directory = workspace.trials / id
        directory.mkdir(parents=True)
        state = next((s for words, s in (broken or {}).items() if words in trial.title), None)
        if state:
            ledger.append(id, state, message="the loss is <nan> at step 2")
            continue
        ledger.append(id, "finished")
        (directory / "result.json").write_text(json.dumps(result_of(trial)))
        write_samples(directory / "samples.npz", samples_of(trial))
    return workspace


def record_of(study: Study = STUDY) -> Record:
    return Record(study, axes=tuple(AXES), command="hma study", provenance=PROVENANCE)


def result_of(trial: Trial) -> dict:
    """Perplexity that falls with data and width; no control without true actions."""
    perplexity = 200 / math.sqrt(trial.max_trajectories * trial.model.width) + trial.train.seed
    delta = 0.0 if trial.shuffle_actions else 0.1 * trial.model.width
    stats = {"perplexity": perplexity, "delta_psnr": delta, "psnr": 20.0, "psnr_copy": 18.0, "ssim": 0.8,
             "accuracy": 0.3}  # fmt: skip
    evaluation = {
        name: {m: {"mean": v + i, "sem": 0.2, "n": 10} for m, v in stats.items()}
        for i, name in enumerate(trial.evaluated)
    }
    vocabulary = {n: {"perplexity": {"mean": 256.0, "sem": 0.0, "n": 2}} for n in trial.evaluated}
    return {
        "evaluation": evaluation,
        "untrained": vocabulary if trial.measure_untrained else None,
        "losses": [5.0, 4.0],
        "parameters": 100 * trial.model.width**2,
        "train_flops": 1e9 * trial.model.width,
        "run": {
            "seconds": 3.0, "finished": "2025-01-01 12:00:00 +0000",
            "machine": {"processor": "abacus", "cores": 2, "devices": ["1 x cpu"], "commit": "abc",
                        "packages": {"jax": "0"}},
        },
    }  # fmt: skip


def samples_of(trial: Trial) -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(zlib.crc32(trial.title.encode()))
    shape = (1, trial.model.frames, 16, 16, 3)
    kinds = ("true", "predicted", "random")
    return {n: {k: rng.integers(0, 255, shape, np.uint8) for k in kinds} for n in trial.evaluated}
