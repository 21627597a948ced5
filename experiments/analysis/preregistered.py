"""The author's preregistered expectations of a study, and their outcomes.

A study keeps it in predictions/preregistered.csv, a line per number, by hand: from whatever was known and thought then,
where `predictions` holds what a fit says by itself. No seal tells when it was written: the column `commit` names the
commit that brought the numbers, whose date and place in the history are the evidence.
"""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from experiments.rows import OVERALL, Row, curve, difference
from experiments.sweeps.registry import AXES
from experiments.sweeps.sweep import POINT
from hma_jax.config import ConfigError, require

FILE = "preregistered.csv"
"""In the folder of predictions, beside the sealed ones of fits."""


@dataclass(frozen=True)
class Expected:
    """The expected value of a mean over seeds and judged robots, with the expected interval."""

    sweep: str
    series: str  # the curve, in a sweep of several
    x: str  # a position on the axis, or its name on an axis of names
    against: str  # another one, of which it is the difference; '': the value itself
    metric: str
    mean: float
    low: float
    high: float
    commit: str
    seeds: tuple[int, ...] = ()  # of these alone; (): of all. The column may be left out.


@dataclass(frozen=True)
class ExpectationOutcome:
    """An expectation and its outcome: `observed`, the mean over `seeds` of the `planned` ones; None before any ran.

    `seed_sem` is its standard error over seeds."""

    expected: Expected
    observed: float | None
    seed_sem: float
    seeds: int
    planned: int

    @property
    def inside(self) -> bool | None:
        if self.observed is None:
            return None
        return self.expected.low <= self.observed <= self.expected.high


def read_expected(path: Path) -> list[Expected]:
    """[] where there is no file. Raises ConfigError, with the line, for one that cannot be read."""
    if not path.exists():
        return []
    columns, numbers = [f.name for f in fields(Expected)], ("mean", "low", "high")
    try:
        text = path.read_text(encoding="utf-8-sig")  # as spreadsheets save it, too
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 ({error}); save it in this encoding") from error
    with io.StringIO(text, newline="") as file:
        reader = csv.DictReader(file)
        known = (columns, columns[:-1])
        require(reader.fieldnames in known, f"{path}: its columns must be {','.join(known[1])}, and optionally seeds")
        found: list[Expected] = []
        lines: dict[tuple, int] = {}  # of each number that is spoken of
        for record in reader:
            number = reader.line_num
            try:
                if None in record.values():
                    raise ValueError("it has too few columns")
                seeds = tuple(int(seed) for seed in record.pop("seeds", "").split())
                found.append(Expected(**record | {name: float(record[name]) for name in numbers}, seeds=seeds))
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{path}, line {number}: not a prediction ({error})") from error
            e = found[-1]
            where = f"{path}, line {number}"
            require(e.low <= e.mean <= e.high, f"{where}: low must not be above mean, and mean not above high")
            require(math.isfinite(e.high - e.low), f"{where}: low and high must be finite")
            # A difference the other way round is the same number.
            positions = frozenset(map(_position, (e.x, e.against)))
            require(len(positions) > 1, f"{where}: x must name a point, and against, if given, another point")
            first = lines.setdefault((e.sweep, e.series, positions, e.metric, frozenset(e.seeds)), number)
            require(
                first == number,
                f"{where}: it predicts the same number as line {first}, which would count twice; keep the one that "
                "was written first",
            )
    return found


def compare_expected(expected: Sequence[Expected], rows: Sequence[Row]) -> list[ExpectationOutcome]:
    """The outcome of every expectation of an axis that is in `rows`; others may still be run. Raises ConfigError for an
    unknown axis, curve, point or metric."""
    points: dict[str, list[Row]] = defaultdict(list)  # once, of a hundred thousand rows
    for row in rows:
        if row.role == POINT and not row.of_robot:
            points[row.sweep].append(row)
    known = {*AXES, *(r.sweep for r in rows)}
    for e in expected:
        require(e.sweep in known, f"{FILE}: no axis {e.sweep!r}; known: {', '.join(sorted(known))}")
    return [_compare_one(e, points[e.sweep]) for e in expected if e.sweep in points]


def _compare_one(e: Expected, rows: Sequence[Row]) -> ExpectationOutcome:
    """`rows`: of the axis, without its controls."""
    where = f"{FILE}: {e.sweep}, {e.series}" if e.series else f"{FILE}: {e.sweep}"
    absent = set(e.seeds) - {r.seed for r in rows}
    require(not absent, f"{where} has no seed {', '.join(map(str, sorted(absent)))}")
    rows = [r for r in rows if not e.seeds or r.seed in e.seeds]
    positions = {(r.x, r.label, r.seed) for r in rows if r.series == e.series}
    for x in filter(None, (e.x, e.against)):
        names = dict.fromkeys(label or f"{at:g}" for at, label, _ in sorted(positions))
        known = any(_names(x, at, label) for at, label, _ in positions)
        require(known, f"{where} has no point {x!r}, but {', '.join(names) or 'none, nor such a curve'}")
    metrics = {r.metric for r in rows if r.scope == OVERALL}
    require(not metrics or e.metric in metrics, f"{where} has no metric {e.metric!r}, but {', '.join(sorted(metrics))}")
    planned = {seed for at, label, seed in positions if _names(e.x, at, label)}
    points = curve(rows, e.sweep, e.metric, series=e.series)
    point, base = (next((p for p in points if _names(x, p.x, p.label)), None) for x in (e.x, e.against))
    seeds = set(point.seeds) if point else set()
    if e.against:
        seeds &= set(base.seeds) if base else set()
    if point is None or not seeds:
        return ExpectationOutcome(e, None, math.nan, 0, len(planned))
    mean, error = difference(point, base) if base and e.against else (point.mean, point.seed_sem)
    return ExpectationOutcome(e, mean, error, len(seeds), len(planned))


def _names(text: str, x: float, label: str) -> bool:
    """Whether `text` means the position `x`, called `label` on an axis of names."""
    return text == label if label else _position(text) == x


def _position(text: str) -> float | str:
    """A position, or its name: 8 and 8.0 are one."""
    try:
        return float(text)
    except ValueError:
        return text
