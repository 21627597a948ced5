"""The author's preregistered expectations of a study, and their outcomes.

A study keeps them in predictions/preregistered.csv, a line per number, written by hand from everything that was known
and thought at the time. (`predictions` holds what a fit alone says.) No seal tells when it was written: the column
`commit` names the commit that brought the numbers, whose date and place in the history are the evidence.
"""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

from experiments.analysis.rows import OVERALL, Row, curve, difference
from experiments.sweeps.registry import AXES
from experiments.sweeps.sweep import POINT, Sweep
from hma_jax.config import ConfigError, require
from hma_jax.evaluation.measures import METRICS

FILE = "preregistered.csv"
"""File in the folder of predictions, beside the sealed predictions of fits."""


@dataclass(frozen=True)
class Expected:
    """The expected value of a mean over seeds and judged robots, with the expected interval."""

    sweep: str
    series: str  # the curve, in a sweep of several
    x: str  # position on the axis, or its name on an axis of names
    against: str  # another position: the value is the difference from it; '': the value itself
    metric: str
    mean: float
    low: float
    high: float
    commit: str
    seeds: tuple[int, ...] = ()  # seeds that are averaged; (): all. This column and those after it may be left out.
    known: tuple[int, ...] = ()  # seeds of x that had run when this was written


@dataclass(frozen=True)
class ExpectationOutcome:
    """An expectation and its outcome: `observed`, the mean over those `seeds` of the `planned` ones that are finished;
    None if there are none, for the reason in `lacks`.

    `seed_sem` is its standard error over seeds."""

    expected: Expected
    observed: float | None
    seed_sem: float
    seeds: int
    planned: int
    lacks: str = ""

    @property
    def inside(self) -> bool | None:
        if self.observed is None:
            return None
        return self.expected.low <= self.observed <= self.expected.high


def read_expected(path: Path) -> list[Expected]:
    """The expectations in a file; [] if there is no file. Raises ConfigError, with the line, for a file that cannot be
    read."""
    if not path.exists():
        return []
    columns, numbers = [f.name for f in fields(Expected)], ("mean", "low", "high")
    optional = [f.name for f in fields(Expected) if f.default is not MISSING]
    needed = columns[: -len(optional)]
    try:
        text = path.read_text(encoding="utf-8-sig")  # also as spreadsheets save it
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 ({error}); save it in this encoding") from error
    with io.StringIO(text, newline="") as file:
        reader = csv.DictReader(file)
        require(
            reader.fieldnames in [columns[:n] for n in range(len(needed), len(columns) + 1)],
            f"{path}: its columns must be {','.join(needed)}, and optionally, in this order, {','.join(optional)}",
        )
        found: list[Expected] = []
        lines: dict[tuple, int] = {}  # line of each number
        for record in reader:
            number = reader.line_num
            try:
                if None in record.values():
                    raise ValueError("it has too few columns")
                of_seeds = {name: tuple(map(int, record.pop(name, "").split())) for name in optional}
                found.append(Expected(**record | {name: float(record[name]) for name in numbers}, **of_seeds))
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{path}, line {number}: not a prediction ({error})") from error
            e = found[-1]
            where = f"{path}, line {number}"
            require(e.low <= e.mean <= e.high, f"{where}: low must not be above mean, and mean not above high")
            require(math.isfinite(e.high - e.low), f"{where}: low and high must be finite")
            some = set(e.known) < set(e.seeds) if e.seeds and e.known else True
            require(
                some,
                f"{where}: known must name some of the seeds, not others and not all, of which nothing is predicted",
            )
            # A difference in the other direction is the same number.
            positions = frozenset(map(_position, (e.x, e.against)))
            require(
                bool(e.x) and len(positions) > 1, f"{where}: x must name a point, and against, if given, another point"
            )
            require(e.metric in METRICS, f"{where}: no metric {e.metric!r}; known: {', '.join(METRICS)}")
            first = lines.setdefault((e.sweep, e.series, positions, e.metric, frozenset(e.seeds)), number)
            require(
                first == number,
                f"{where}: it predicts the same number as line {first}, which would count twice; keep the one that "
                "was written first",
            )
    return found


def find_unplanned(expected: Sequence[Expected], sweeps: Sequence[Sweep]) -> list[str]:
    """Expectations on the axes of `sweeps` that are not planned, each with what is planned instead, and axes that are
    neither among these nor the project's: the user's own, or mistyped."""
    known = {*AXES, *(s.name for s in sweeps)}
    lines = [f"no axis {name!r}" for name in dict.fromkeys(e.sweep for e in expected) if name not in known]
    for sweep in sweeps:
        points = [(p.series, p.x, sweep.label(p.x), p.trial.train.seed) for p in sweep.points if p.role == POINT]
        lines += [_why_unplanned(e, points) for e in expected if e.sweep == sweep.name]
    return list(filter(None, lines))


def compare_expected(expected: Sequence[Expected], rows: Sequence[Row]) -> list[ExpectationOutcome]:
    """The outcome of every expectation of an axis that is in `rows`; others may still be run."""
    points: dict[str, list[Row]] = defaultdict(list)  # once, out of a hundred thousand rows
    for row in rows:
        if row.role == POINT and not row.of_robot:
            points[row.sweep].append(row)
    return [_compare_one(e, points[e.sweep]) for e in expected if e.sweep in points]


def count_inside(outcomes: Sequence[ExpectationOutcome]) -> tuple[int, int]:
    """(how many lie inside their interval, how many there are) of those that have been observed."""
    known = [o.inside for o in outcomes if o.inside is not None]
    return sum(known), len(known)


def _why_unplanned(e: Expected, points: Collection[tuple[str, float, str, int]]) -> str:
    """What is expected but not among the axis's `points` (series, x, label, seed); '' if everything is."""
    where = f"{e.sweep}, {e.series}" if e.series else e.sweep
    own = [(x, label, seed) for series, x, label, seed in points if series == e.series]
    if not own:
        return f"{where}: no such curve"
    if absent := set(e.seeds) - {seed for _, _, seed in own}:
        return f"{where} has no seed {', '.join(map(str, sorted(absent)))}"
    own = [point for point in own if not e.seeds or point[2] in e.seeds]
    for x in filter(None, (e.x, e.against)):
        if not any(_names(x, at, label) for at, label, _ in own):
            names = dict.fromkeys(label or f"{at:g}" for at, label, _ in sorted(own))
            return f"{where} has no point {x!r}, but {', '.join(names)}"
    return ""


def _compare_one(e: Expected, rows: Sequence[Row]) -> ExpectationOutcome:
    """`rows`: of the axis, without its controls."""
    positions = {(r.series, r.x, r.label, r.seed) for r in rows}
    if _why_unplanned(e, positions):
        return ExpectationOutcome(e, None, math.nan, 0, 0, "not planned")
    rows = [r for r in rows if not e.seeds or r.seed in e.seeds]
    planned = {r.seed for r in rows if r.series == e.series and _names(e.x, r.x, r.label)}
    points = curve(rows, e.sweep, e.metric, series=e.series)
    point, base = (next((p for p in points if _names(x, p.x, p.label)), None) for x in (e.x, e.against))
    seeds = set(point.seeds) if point else set()
    if e.against:
        seeds &= set(base.seeds) if base else set()
    if point is None or not seeds:
        measured = {r.metric for r in rows if r.scope == OVERALL}
        lacks = "not measured" if measured and e.metric not in measured else "not run yet"
        return ExpectationOutcome(e, None, math.nan, 0, len(planned), lacks)
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
