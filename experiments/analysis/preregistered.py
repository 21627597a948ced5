"""What the author of a study expected of its points, written down before they ran; and what came.

A study keeps it in predictions/preregistered.csv, a line per number, by hand: from whatever was known and thought then,
where `predictions` holds what a fit says by itself. No seal tells when it was written: the column `commit` names the
commit that brought the numbers, whose date and place in the history are the evidence.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from experiments.rows import Row, curve, difference
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


@dataclass(frozen=True)
class Came:
    """One expectation beside what came: `observed` with its standard error over seeds, None before any trial ran."""

    expected: Expected
    observed: float | None
    seed_sem: float

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
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        require(reader.fieldnames == columns, f"{path}: its columns have to be {','.join(columns)}")
        found = []
        for number, record in enumerate(reader, start=2):
            try:
                if None in record.values():
                    raise ValueError("it has too few columns")
                found.append(Expected(**record | {name: float(record[name]) for name in numbers}))
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{path}, line {number}: no prediction ({error})") from error
            e = found[-1]
            require(e.low <= e.mean <= e.high, f"{path}, line {number}: low, mean and high do not ascend")
    return found


def what_came(expected: Iterable[Expected], rows: Sequence[Row]) -> list[Came]:
    """Of every expectation of an axis that `rows` have. Raises ConfigError for a curve or a point that is not there."""
    axes = {r.sweep for r in rows}
    found = []
    for e in expected:
        if e.sweep not in axes:
            continue
        places = {(r.x, r.label) for r in rows if (r.sweep, r.series) == (e.sweep, e.series)}
        for x in filter(None, (e.x, e.against)):
            where = f"{e.sweep}, {e.series}" if e.series else e.sweep
            require(any(_names(x, *place) for place in places), f"{FILE}: {where} has no point {x!r}")
        points = curve(rows, e.sweep, e.metric, series=e.series)
        point, base = (next((p for p in points if _names(x, p.x, p.label)), None) for x in (e.x, e.against))
        if point is None or (e.against and base is None):
            found.append(Came(e, None, math.nan))
        elif base is None:
            found.append(Came(e, point.mean, point.seed_sem))
        else:
            found.append(Came(e, *difference(point, base)))
    return found


def _names(text: str, x: float, label: str) -> bool:
    """Whether `text` means the position `x`, called `label` on an axis of names."""
    if label:
        return text == label
    try:
        return float(text) == x
    except ValueError:
        return False
