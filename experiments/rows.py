"""From finished trials to tidy rows: one row per (sweep, x, seed, role, scope, metric).

The CSV holds what is determined by the trials only (no clocks), so a study that was killed
and resumed writes the same bytes as one that was not. Plots and tables are made from it.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.ledger import FINISHED
from experiments.provenance import Provenance
from experiments.runner import State
from experiments.sweep import Point, Sweep
from experiments.trial import trial_id
from hma_jax.config import ConfigError

OVERALL = "overall"
"""The scope that averages over all datasets of a sweep, each counting equally."""

CURVES = ("perplexity", "delta_psnr")


@dataclass(frozen=True)
class Row:
    """One number with its standard error over `n` windows, and where it comes from.

    A trial without a result has one row per sweep, with `metric` empty.
    """

    sweep: str
    x: int
    role: str  # "point", "control" (shuffled actions) or "untrained"
    seed: int
    trial: str
    status: str  # a state of `ledger`
    scope: str  # OVERALL or a dataset
    metric: str
    mean: float
    sem: float
    n: int
    parameters: int
    train_flops: float
    store: str
    manifest: str
    tokenizer: str
    code: str


def load_result(trials: Path, id: str) -> dict[str, Any]:
    """What `run_trial` wrote. Raises ConfigError if it cannot be read."""
    path = trials / id / "result.json"
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: unreadable ({error}); delete its directory to run it again") from error


def collect(
    sweeps: Sequence[Sweep], provenance: Provenance, trials: Path, states: dict[str, State]
) -> list[Row]:
    """Rows of every point of every sweep, in a fixed order."""
    rows = []
    for sweep in sweeps:
        for point in sweep.points:
            id = trial_id(point.trial, provenance)
            state = states[id].event
            result = load_result(trials, id) if state == FINISHED else None
            rows += _rows(sweep, point, id, state, result, provenance)
    return rows


def _rows(
    sweep: Sweep, point: Point, id: str, state: str, result: dict[str, Any] | None, provenance: Provenance
) -> list[Row]:
    from hma_jax.evaluation.protocol import Evaluation

    def row(role: str, scope: str, metric: str, mean: float, sem: float, n: int) -> Row:
        return Row(
            sweep=sweep.name, x=point.x, role=role, seed=point.trial.train.seed, trial=id, status=state,
            scope=scope, metric=metric, mean=mean, sem=sem, n=n,
            parameters=result["parameters"] if result else 0,
            train_flops=result["train_flops"] if result else 0.0,
            **dataclasses.asdict(provenance),
        )  # fmt: skip

    if result is None:
        return [row(point.role, "", "", math.nan, math.nan, 0)]
    parts = [(point.role, Evaluation.from_dict(result["evaluation"]))]
    if result["untrained"]:
        parts.append(("untrained", Evaluation.from_dict(result["untrained"])))
    rows = []
    for role, evaluation in parts:
        judged = [name for name in sweep.scope if name in evaluation.datasets]  # those with windows
        scopes = {OVERALL: evaluation.over(judged)}
        scopes |= {name: evaluation.datasets[name] for name in judged}
        for scope, metrics in scopes.items():
            rows += [row(role, scope, m, s.mean, s.sem, s.n) for m, s in sorted(metrics.items())]
    return rows


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    aside = path.with_suffix(".csv.tmp")
    with open(aside, "w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in dataclasses.fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(dataclasses.asdict(row) for row in rows)
    os.replace(aside, path)


def read_csv(path: Path) -> list[Row]:
    kinds = {"x": int, "seed": int, "n": int, "parameters": int}
    kinds |= {"mean": float, "sem": float, "train_flops": float}
    with open(path, newline="") as file:
        return [Row(**{k: kinds.get(k, str)(v) for k, v in record.items()}) for record in csv.DictReader(file)]


@dataclass(frozen=True)
class CurvePoint:
    """The seeds of one x together. `sem` joins the spread over seeds and over windows."""

    x: int
    mean: float
    sem: float
    seeds: tuple[float, ...]
    parameters: int


def curve(
    rows: Iterable[Row], sweep: str, metric: str, role: str = "point", scope: str = OVERALL
) -> list[CurvePoint]:
    """The points of a curve by increasing x.

    sem^2 = variance over seeds / seeds + mean of the windows' sem^2: all seeds are judged on the
    same windows, so that the second part does not shrink with their number.
    """
    groups: dict[int, list[Row]] = defaultdict(list)
    for r in rows:
        if (r.sweep, r.metric, r.role, r.scope) == (sweep, metric, role, scope):
            groups[r.x].append(r)
    points = []
    for x, group in sorted(groups.items()):
        means = [r.mean for r in group]
        mean = sum(means) / len(means)
        spread = sum((m - mean) ** 2 for m in means) / max(len(means) - 1, 1) / len(means)
        windows = sum(r.sem**2 for r in group) / len(group)
        points.append(CurvePoint(x, mean, math.sqrt(spread + windows), tuple(means), group[0].parameters))
    return points


def tally(rows: Iterable[Row], sweep: str) -> tuple[int, int]:
    """(finished, all) trials of a sweep's curve and control."""
    status = {(r.trial, r.x): r.status for r in rows if r.sweep == sweep and r.role != "untrained"}
    return sum(s == FINISHED for s in status.values()), len(status)
