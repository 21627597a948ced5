"""trials.parquet: a row per trial of a study, its configuration and its results, flat.

Columns:

    trial, title, status       its id, what tells it from the others, and a state of the ledger
    config.*                   every setting by its dotted path ("config.train.optimizer.learning_rate"); lists as JSON
    store, manifest, tokenizer, results     what it depends on (`experiments.running.provenance`)
    windows_drawn              in training: steps times batch. Epochs are not one number: robots differ in windows
    trajectories               that windows are drawn of, of all robots, as `trajectories_of` counts; null where unknown
    parameters, train_flops, training_loss  the last is the mean over the last steps
    <metric>, <metric>.sem     over all robots that it was judged on, each counting equally
    windows, episodes, robots  that these are means over

It holds no times and nothing about machines: a study that was killed and resumed writes the same bytes. Results of a
trial without a result are null.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from experiments.analysis.rows import training_loss
from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trajectories_of
from hma_jax.config.json import leaves, to_dict
from hma_jax.evaluation.summary import Summary
from hma_jax.evaluation.windows import write_arrow


def trial_row(
    id: str,
    title: str,
    status: str,
    trial: Trial,
    provenance: Provenance,
    result: dict[str, Any] | None,
    available: Mapping[str, int],
) -> dict[str, Any]:
    """One row; `result` is that of result.json (None: there is none), `available` the training trajectories with
    windows that each robot has."""
    row = {"trial": id, "title": title, "status": status}
    for path, value in leaves(to_dict(trial)).items():
        row[f"config.{path}"] = json.dumps(value) if isinstance(value, list) else value
    row |= dataclasses.asdict(provenance)
    used = trajectories_of(trial, available, result)
    row["windows_drawn"] = trial.train.steps * trial.train.batch
    row["trajectories"] = sum(used.values()) if used.keys() == set(trial.datasets) else None
    if result is None:
        return row
    summary = Summary.from_dict(result["evaluation"])
    row |= {name: result[name] for name in ("parameters", "train_flops")}
    row["training_loss"] = training_loss(result).mean
    row["robots"] = len(summary.datasets)
    for metric, stat in summary.overall.items():
        row |= {metric: stat.mean, f"{metric}.sem": stat.sem}
        row["windows"], row["episodes"] = max(row.get("windows", 0), stat.n), max(row.get("episodes", 0), stat.episodes)
    return row


def write_trials(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Writes the rows, which need not have the same columns, completely or not at all."""
    import pyarrow as pa

    rows = list(rows)
    columns = dict.fromkeys(name for row in rows for name in row)
    write_arrow(path, pa.table({name: [row.get(name) for row in rows] for name in columns}))
