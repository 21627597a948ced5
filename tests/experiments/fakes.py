"""A study that has run, without running it: results on disk as `run_trial` leaves them."""

import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.analysis.rows import Row, collect
from experiments.presets import SMOKE
from experiments.report.numbers import read_results
from experiments.running.attempts import OUTPUT, read_states
from experiments.running.ledger import Ledger
from experiments.running.provenance import Provenance, Start, TrialRecord
from experiments.running.result_file import write_result
from experiments.running.run_trial import last_loss, write_samples
from experiments.running.trial import Trial
from experiments.running.workspace import Record, Workspace
from experiments.study import SCALING, Study, TransferConfig
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import Sweep, titles, unique_trials
from hma_jax.config.json import to_dict

PROVENANCE = Provenance(store="5708e", manifest="3a41f", tokenizer="70c3")
RECORD = TrialRecord(PROVENANCE, {"c0de": {"experiments.running.trial": "1"}}, {}, (Start("c0de", {"commit": "abc"}),))
STUDY = replace(
    SMOKE,
    datasets=("arm", "rover", "pusher"),
    dataset_counts=(2, 3),
    trajectory_counts=(2, 4, 8),
    widths=(8, 16),
    seeds=(0, 1),
    ablation_seeds=(0, 1, 2),
    transfer=TransferConfig(widths=(8, 16, 32)),
)


def finished_study(
    root: Path,
    study: Study = STUDY,
    broken: dict[str, str] | None = None,
    axes: Sequence[str] = SCALING,
    without: Sequence[str] = (),
) -> Workspace:
    """A workspace with a result for every trial, but a failure for titles that contain a key of
    `broken` (its value is the state). Ready for `draw`. Metrics in `without` are left
    out, as by a model that has none."""
    workspace = Workspace(root)
    ledger = Ledger(workspace.ledger)
    sweeps = plan_sweeps(study, axes, root)
    names = titles(sweeps, PROVENANCE)
    for id, trial in unique_trials(sweeps, PROVENANCE).items():
        directory = workspace.trials / id
        directory.mkdir(parents=True)
        state = next((s for words, s in (broken or {}).items() if words in names[id]), None)
        if state:
            ledger.append(id, state, message=f"the loss is <nan> at step 2; output in {directory / OUTPUT}")
            continue
        ledger.append(id, "finished")
        (directory / "job.json").write_text(json.dumps({"trial": to_dict(trial), "provenance": to_dict(PROVENANCE),
                                                        "execution": to_dict(study.execution)}))  # fmt: skip
        (directory / "provenance.json").write_text(json.dumps(to_dict(RECORD)))
        write_samples(directory / "samples.npz", samples_of(trial))
        write_result(directory, result_of(trial, without))
    return workspace


def record_of(study: Study = STUDY, axes: Sequence[str] = SCALING) -> Record:
    return Record(study, axes=tuple(axes), command="hma study", provenance=PROVENANCE)


def rows_of(workspace: Workspace, sweeps: Sequence[Sweep]) -> list[Row]:
    """The rows that `draw` would draw, without drawing."""
    ids = list(unique_trials(sweeps, PROVENANCE))
    states = read_states(ids, workspace.trials, Ledger(workspace.ledger))
    results, _ = read_results(workspace, ids)
    return collect(sweeps, PROVENANCE, workspace.trials, states, results)


def best_rate(trial: Trial) -> float:
    """Where the fake loss is lowest: fixed under muP, falling with width without it."""
    rate = STUDY.train.optimizer.learning_rate
    return rate if trial.model.mup.enabled else rate * trial.model.mup.base_width / trial.model.width


def result_of(trial: Trial, without: Sequence[str] = ()) -> dict:
    """Perplexity that falls with data, width and conditioning on actions; no control without true
    actions."""
    setting, model = trial.train.masking.setting, trial.model
    blind = trial.shuffle_actions or setting == "passive"
    handicap = {"passive": 2.0, "full": 1.0}.get(setting, 0.0)
    handicap += {"concat": 0.5, "add": 0.8}.get(model.conditioning, 0.0)
    off = math.log2(trial.train.optimizer.learning_rate / best_rate(trial))
    perplexity = 200 / math.sqrt(trial.max_trajectories * model.width) + trial.train.seed + handicap + off**2
    delta = 0.0 if blind else 0.1 * model.width
    stats = {"perplexity": perplexity, "cross_entropy": math.log(perplexity), "delta_psnr": delta,
             "psnr": 20.0, "psnr_copy": 18.0, "ssim": 0.8, "accuracy": 0.3}  # fmt: skip
    evaluation = {
        name: {m: {"mean": v + i, "sem": 0.2, "n": 10, "episodes": 4} for m, v in stats.items() if m not in without}
        for i, name in enumerate(trial.evaluated)
    }
    untrained = {"perplexity": 256.0, "cross_entropy": math.log(256.0), "psnr": 256.0}
    first = {m: {"mean": v, "sem": 0.0, "n": 2, "episodes": 2} for m, v in untrained.items() if m not in without}
    return {
        "evaluation": evaluation,
        "untrained": dict.fromkeys(trial.evaluated, first) if trial.measure_untrained else None,
        "training_loss": last_loss([5.0] * 18 + [4.0 + off**2 / 10, 3.0 + off**2 / 10]),
        "parameters": 100 * model.width**2,
        "train_flops": 1e9 * model.width,
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
