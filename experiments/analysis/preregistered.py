"""What the author of a study expected of its points, written down before they ran; and what came.

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

from experiments.rows import Row, curve, difference
from experiments.sweeps.registry import AXES
from experiments.sweeps.sweep import POINT
from hma_jax.config import ConfigError, require

FILE = "preregistered.csv"
"""In the folder of predictions, beside the sealed ones of fits."""


@dataclass(frozen=True)
class Expected:
    """A number that the mean over seeds and judged robots was expected to be, with the interval it was given."""

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
class Came:
    """One expectation beside what came: `observed`, the mean over `seeds` of the `planned` ones; None before any ran.

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
        raise ConfigError(f"{path} is not UTF-8 ({error}); save it as such") from error
    with io.StringIO(text, newline="") as file:
        reader = csv.DictReader(file)
        known = (columns, columns[:-1])
        require(reader.fieldnames in known, f"{path}: its columns have to be {','.join(known[1])}, and may be seeds")
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
                raise ConfigError(f"{path}, line {number}: no prediction ({error})") from error
            e = found[-1]
            where = f"{path}, line {number}"
            require(e.low <= e.mean <= e.high, f"{where}: low, mean and high do not ascend")
            require(math.isfinite(e.high - e.low), f"{where}: an interval without an end holds more than can come")
            places = frozenset(map(_place, (e.x, e.against)))  # a difference the other way round is the same number
            require(len(places) > 1, f"{where}: x has to name a point, and against, if it is given, another one")
            first = lines.setdefault((e.sweep, e.series, places, e.metric, frozenset(e.seeds)), number)
            require(
                first == number,
                f"{where}: of the same number as line {first}, which would count twice; keep the one that "
                "was written first",
            )
    return found


def what_came(expected: Sequence[Expected], rows: Sequence[Row]) -> list[Came]:
    """Of every expectation of an axis that `rows` have; other axes may come. Raises ConfigError for an axis, a curve, a
    point or a metric that is not there."""
    points: dict[str, list[Row]] = defaultdict(list)  # once, of a hundred thousand rows
    for row in rows:
        if row.role == POINT and not row.of_robot:
            points[row.sweep].append(row)
    known = {*AXES, *(r.sweep for r in rows)}
    for e in expected:
        require(e.sweep in known, f"{FILE}: no axis {e.sweep!r}; known: {', '.join(sorted(known))}")
    return [_came(e, points[e.sweep]) for e in expected if e.sweep in points]


def _came(e: Expected, rows: Sequence[Row]) -> Came:
    """`rows`: of the axis, without its controls."""
    where = f"{FILE}: {e.sweep}, {e.series}" if e.series else f"{FILE}: {e.sweep}"
    absent = set(e.seeds) - {r.seed for r in rows}
    require(not absent, f"{where} has no seed {', '.join(map(str, sorted(absent)))}")
    rows = [r for r in rows if not e.seeds or r.seed in e.seeds]
    places = {(r.x, r.label, r.seed) for r in rows if r.series == e.series}
    for x in filter(None, (e.x, e.against)):
        there = dict.fromkeys(label or f"{place:g}" for place, label, _ in sorted(places))
        known = any(_names(x, place, label) for place, label, _ in places)
        require(known, f"{where} has no point {x!r}, but {', '.join(there) or 'none, nor such a curve'}")
    metrics = {r.metric for r in rows} - {""}
    require(not metrics or e.metric in metrics, f"{where} has no metric {e.metric!r}, but {', '.join(sorted(metrics))}")
    planned = {seed for place, label, seed in places if _names(e.x, place, label)}
    points = curve(rows, e.sweep, e.metric, series=e.series)
    point, base = (next((p for p in points if _names(x, p.x, p.label)), None) for x in (e.x, e.against))
    seeds = set(point.seeds) if point else set()
    if e.against:
        seeds &= set(base.seeds) if base else set()
    if point is None or not seeds:
        return Came(e, None, math.nan, 0, len(planned))
    mean, error = difference(point, base) if base and e.against else (point.mean, point.seed_sem)
    return Came(e, mean, error, len(seeds), len(planned))


def _names(text: str, x: float, label: str) -> bool:
    """Whether `text` means the position `x`, called `label` on an axis of names."""
    return text == label if label else _place(text) == x


def _place(text: str) -> float | str:
    """A position, or its name: 8 and 8.0 are one."""
    try:
        return float(text)
    except ValueError:
        return text
