"""From finished trials to tidy rows: one row per (sweep, x, seed, role, scope, metric).

results.csv has the rows of means over robots; robots.parquet has those of single robots, which are forty times as many.
They hold only what is determined by the trials (no times), so a study that was killed and resumed writes the same bytes
as one that was not. Plots and tables are made from them.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.analysis.intervals import OVERALL
from experiments.running.attempts import State
from experiments.running.ledger import FINISHED
from experiments.running.provenance import Provenance, read_record
from experiments.running.run_trial import last_loss
from experiments.running.trial import trial_id
from experiments.running.workspace import Workspace
from experiments.sweeps.sweep import CONTROL, POINT, Point, Sweep
from hma_jax.config import ConfigError
from hma_jax.evaluation.statistics import Stat
from hma_jax.evaluation.sums import add_up
from hma_jax.evaluation.windows import read_arrow, write_arrow
from hma_jax.runtime.files import write_file

UNTRAINED = "untrained"
"""The role of the reference trial before its first step."""

TRAINING, TRAINING_LOSS = "training", "loss"
"""Scope and metric of the objective on the trial's own mixture, averaged over its last steps."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number with its standard error, and where it comes from.

    It is a mean over `n` windows of `episodes` episodes, over which the error is taken (the training loss: over `n`
    steps, `episodes` 0). A trial without a result has one row per sweep, with `metric` empty. Fields with a default are
    missing in some committed tables.
    """

    sweep: str
    x: float
    label: str = ""  # the name of x, on an axis of names
    role: str  # a role of `sweep`, or UNTRAINED
    series: str = ""  # the curve, if the sweep has several
    seed: int
    trial: str
    status: str  # a state of `ledger`
    scope: str  # OVERALL, a dataset or TRAINING
    metric: str
    mean: float
    sem: float
    n: int
    episodes: int = 0
    parameters: int
    train_flops: float
    store: str
    manifest: str
    tokenizer: str
    results: int = 0  # version of what trials compute (`results_version`); 0 before they were numbered
    code: str = ""  # hash of the sources that the trial ran (`closure`)

    @property
    def of_robot(self) -> bool:
        """Whether it is for one robot, not for all that the sweep judges."""
        return self.scope not in (OVERALL, TRAINING, "")


def collect(
    sweeps: Sequence[Sweep],
    provenance: Provenance,
    trials: Path,
    states: Mapping[str, State],
    results: Mapping[str, dict[str, Any]],
) -> list[Row]:
    """Rows of every point of every sweep, in a fixed order; `results` are those of finished trials in `trials`."""
    rows = []
    for sweep in sweeps:
        for point in sweep.points:
            id = trial_id(point.trial, provenance)
            state = states[id].event
            result = results[id] if state == FINISHED else None
            record = read_record(trials / id) if result else None
            origin = {**dataclasses.asdict(provenance), "code": record.code if record else ""}
            rows += _rows(sweep, point, id, state, result, origin)
    return rows


def _rows(
    sweep: Sweep, point: Point, id: str, state: str, result: dict[str, Any] | None, origin: dict[str, Any]
) -> list[Row]:
    from hma_jax.evaluation.summary import Summary

    def row(role: str, scope: str, metric: str, stat: Stat) -> Row:
        return Row(
            sweep=sweep.name, x=point.x, label=sweep.label(point.x), role=role, series=point.series,
            seed=point.trial.train.seed, trial=id, status=state,
            scope=scope, metric=metric, **vars(stat),
            parameters=result["parameters"] if result else 0,
            train_flops=result["train_flops"] if result else 0.0,
            **origin,
        )  # fmt: skip

    if result is None:
        return [row(point.role, "", "", Stat(math.nan, math.nan, 0))]
    parts = [(point.role, Summary.from_dict(result["evaluation"]))]
    if result["untrained"]:
        parts.append((UNTRAINED, Summary.from_dict(result["untrained"])))
    rows = [row(point.role, TRAINING, TRAINING_LOSS, training_loss(result))]
    for role, summary in parts:
        judged = [name for name in point.scope or sweep.scope if name in summary.datasets]  # datasets with windows
        scopes = {OVERALL: summary.over(judged)}
        scopes |= {name: summary.datasets[name] for name in judged}
        for scope, metrics in scopes.items():
            rows += [row(role, scope, m, s) for m, s in sorted(metrics.items())]
    return rows


def training_loss(result: dict[str, Any]) -> Stat:
    """The mean of a run's last steps. Some committed results hold the loss of every step instead."""
    return Stat(**(result.get("training_loss") or last_loss(result["losses"])))


def write_rows(workspace: Workspace, rows: Iterable[Row]) -> None:
    """Writes results.csv and robots.parquet, each completely or not at all."""
    import pyarrow as pa

    rows = list(rows)
    write_csv(workspace.results, Row, (r for r in rows if not r.of_robot))
    of_robots = [r for r in rows if r.of_robot]
    columns = {f.name: [getattr(r, f.name) for r in of_robots] for f in dataclasses.fields(Row)}
    write_arrow(workspace.robots, pa.table(columns))


def read_rows(workspace: Workspace) -> list[Row]:
    """Reads what `write_rows` wrote; some committed tables have everything in results.csv. Raises ConfigError for a
    damaged one."""
    import pyarrow as pa

    rows = read_csv(workspace.results)
    if not workspace.robots.exists():
        return rows
    try:
        return rows + [Row(**record) for record in read_arrow(workspace.robots).to_pylist()]
    except (pa.ArrowException, OSError, TypeError) as error:
        raise ConfigError(
            f"{workspace.robots}: not a table of rows ({error}); restore the file, or remove it and draw it again from "
            "the trials with `hma report`"
        ) from error


def place_rows(rows: Iterable[Row], sweeps: Sequence[Sweep]) -> tuple[list[Row], list[str]]:
    """(rows of a table at the positions that their names have on the axes of today's `sweeps`, names that an axis no
    longer has, whose rows are left out): on an axis of names x counts those that it had when the table was written."""
    places = {sweep.name: {label: x for x, label in enumerate(sweep.labels)} for sweep in sweeps if sweep.labels}
    placed, gone = [], dict[str, None]()
    for r in rows:
        names = places.get(r.sweep)
        if not names or not r.label:  # an axis of numbers, or a table without names
            placed.append(r)
        elif r.label in names:
            placed.append(r if r.x == names[r.label] else dataclasses.replace(r, x=names[r.label]))
        else:
            gone[f"{r.label} (axis {r.sweep})"] = None
    return placed, list(gone)


def write_csv(path: Path, kind: type, rows: Iterable[Any]) -> None:
    """A line for each of `rows`, dataclasses of one `kind`."""
    write_file(path, csv_text(kind, rows))


def csv_text(kind: type, rows: Iterable[Any]) -> str:
    """What `write_csv` writes."""
    content = io.StringIO()
    writer = csv.DictWriter(content, [f.name for f in dataclasses.fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(vars(row) for row in rows)
    return content.getvalue()


def read_csv(path: Path) -> list[Row]:
    """The rows of a table. Raises ConfigError for a damaged one."""
    kinds = {"x": _number, "seed": int, "n": int, "episodes": int, "parameters": int, "results": int}
    kinds |= {"mean": float, "sem": float, "train_flops": float}
    rows = []
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        try:
            for record in reader:
                rows.append(Row(**{k: kinds.get(k, str)(v) for k, v in record.items()}))
        except (ValueError, TypeError, AttributeError, csv.Error) as error:
            raise ConfigError(
                f"{path}, line {len(rows) + 2}: not a row of results ({error}); restore the file, or remove it and draw "
                "it again from the trials with `hma report`"
            ) from error
    return rows


def _number(text: str) -> float:
    """An int if it was one, else a float."""
    return int(text) if text.isdigit() else float(text)


def of_sweep(rows: Iterable[Row], sweep: str) -> list[Row]:
    """The rows of one axis; a study has many axes."""
    return [r for r in rows if r.sweep == sweep]


@dataclass(frozen=True)
class CurvePoint:
    """The seeds of one x together.

    `sem` combines the spread over seeds and over episodes (`curve`). `seed_sem` is the former alone, nan for a single
    seed: the error of a comparison on the same windows.
    """

    x: float
    mean: float
    sem: float
    seed_sem: float
    seeds: dict[int, float]  # the mean of each seed
    parameters: tuple[int, ...]  # the numbers that its seeds have, in order: several if robots are drawn
    label: str = ""
    clustered: bool = True  # by episode, as errors of each seed are; in some committed tables windows stand alone


def curve(
    rows: Iterable[Row],
    sweep: str,
    metric: str,
    role: str = POINT,
    scope: str = OVERALL,
    series: str = "",
    robots_vary: bool = False,
) -> list[CurvePoint]:
    """The points of a curve by increasing x; none if no trial has the metric.

    sem^2 = variance over seeds / seeds + mean of each seed's sem^2 over episodes: all seeds are judged on the same
    windows, so the second part does not shrink with their number. If every seed judges its own robots
    (`Sweep.robots_vary`), it also has its own windows, whose effect is part of the variance over seeds: with several
    seeds only the first part is used. The same holds for the training loss, which every seed has from its own steps.
    """
    own_windows = robots_vary or scope == TRAINING
    groups: dict[float, list[Row]] = defaultdict(list)
    for r in rows:
        # A few of a hundred thousand rows are meant, so the test that most of them fail comes first.
        if r.scope == scope and r.metric == metric and r.sweep == sweep and r.role == role and r.series == series:
            groups[r.x].append(r)
    points = []
    for x, group in sorted(groups.items()):
        means = [r.mean for r in group]
        mean = add_up(means) / len(means)
        spread = add_up((m - mean) ** 2 for m in means) / max(len(means) - 1, 1) / len(means)
        episodes = add_up(r.sem**2 for r in group) / len(group) if len(group) == 1 or not own_windows else 0.0
        points.append(
            CurvePoint(
                x, mean, sem=math.sqrt(spread + episodes),
                seed_sem=math.sqrt(spread) if len(group) > 1 else math.nan,
                seeds={r.seed: r.mean for r in group}, label=group[0].label,
                parameters=tuple(sorted({r.parameters for r in group})),
                clustered=scope == TRAINING or all(r.episodes for r in group),
            )
        )  # fmt: skip
    return points


def by_seed(a: CurvePoint, b: CurvePoint) -> list[float]:
    """a minus b for every seed that both have."""
    return [a.seeds[seed] - b.seeds[seed] for seed in a.seeds if seed in b.seeds]


def difference(a: CurvePoint, b: CurvePoint) -> tuple[float, float]:
    """a minus b over the seeds that both have, and its standard error over seeds (nan for one).

    Paired: a seed draws the same windows and, for the parameters that both have, the same initial values.
    """
    pairs = by_seed(a, b)
    if not pairs:
        return math.nan, math.nan
    mean = add_up(pairs) / len(pairs)
    if len(pairs) == 1:
        return mean, math.nan
    return mean, math.sqrt(add_up((d - mean) ** 2 for d in pairs) / (len(pairs) - 1) / len(pairs))


def all_series(rows: Iterable[Row], sweep: str) -> dict[str, list[str]]:
    """{role: its series} of a sweep with several curves, in the order of the rows, without controls and untrained
    models, which make no curve."""
    found: dict[str, list[str]] = {}
    for r in rows:
        of_curve = r.sweep == sweep and r.series and r.role not in (UNTRAINED, CONTROL)
        if of_curve and r.series not in found.setdefault(r.role, []):
            found[r.role].append(r.series)
    return found


def tally(rows: Iterable[Row], sweep: str) -> tuple[int, int]:
    """(finished, all) trials of a sweep, including its control."""
    status = {(r.trial, r.x): r.status for r in rows if r.sweep == sweep and r.role != UNTRAINED}
    return sum(s == FINISHED for s in status.values()), len(status)
