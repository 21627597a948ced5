"""What films come to: a row per robot and minute, and their means over robots with intervals."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from experiments.analysis.intervals import critical
from experiments.applications.detector import CLOSE_PX, MIN_CONFIDENCE
from experiments.applications.endurance.films import Film
from experiments.applications.scenes import VISIBLE_SHARE

STILL = 1e-3
"""Pixels: what varies less does not move."""

STEP = 1.0
"""Pixels: where a tool goes by less from a frame to the next, its direction is not told."""

Row = dict[str, object]

MEASURES = (
    "psnr", "psnr_still", "tool_found", "tool_close", "tool_px", "object_found", "object_close", "object_px", "follows",
    "moves", "steers", "true_tool_close", "true_object_close", "true_follows", "true_moves", "true_steers", "level",
    "variance", "histogram",
)  # fmt: skip


def measure(film: Film, part: slice, tools: int) -> dict[str, float]:
    """`MEASURES` of the frames `part` of a film whose first `tools` points are tools, of what is seen in truth."""
    found: dict[str, float] = {"psnr": film.psnr[part].mean(), "psnr_still": film.still[part].mean()}
    there = film.true_share[part] >= VISIBLE_SHARE
    for name, position, confidence in (
        ("", film.position, film.confidence), ("true_", film.seen_position, film.seen_confidence),
    ):  # fmt: skip
        off = np.linalg.norm(position[part] - film.true_position[part], axis=-1)
        sure = confidence[part] >= MIN_CONFIDENCE
        for kind, which in (("tool", slice(None, tools)), ("object", slice(tools, None))):
            mine = there[:, which]
            far, known = off[:, which][mine], sure[:, which][mine]
            found |= {
                f"{name}{kind}_found": known.mean(), f"{name}{kind}_close": (known & (far <= CLOSE_PX)).mean(),
                f"{name}{kind}_px": np.median(far),
            }  # fmt: skip
    for name, position in (("", film.position), ("true_", film.seen_position)):
        found |= motion(film.true_position[part, :tools], position[part, :tools], there[:, :tools], name)
    found |= {name: getattr(film, name)[part].mean() for name in ("level", "variance", "histogram")}
    return {name: float(found[name]) for name in MEASURES}


def motion(true: np.ndarray, seen: np.ndarray, there: np.ndarray, prefix: str) -> dict[str, float]:
    """How the motion of tools [n, M, 2] that is seen follows what the commands do in the true simulator, from frame to
    frame where a tool is in view. Pearson's correlations: `follows`, of displacements across and down, their mean;
    `moves`, of how far they go alone; `steers`, of displacements along and aside of the one before, their mean. The
    last two do not mind that a robot is turned otherwise than in truth, as one whose commands are velocities in its own
    frame will be after the first error; `steers` minds where it goes from there."""
    both = there[1:] & there[:-1]
    true_moves, seen_moves = np.diff(true, axis=0), np.diff(seen, axis=0)
    pairs = {"follows": [(true_moves[both][:, a], seen_moves[both][:, a]) for a in (0, 1)]}
    pairs["moves"] = [(np.linalg.norm(true_moves[both], axis=-1), np.linalg.norm(seen_moves[both], axis=-1))]
    turns = both[1:] & both[:-1] & (np.linalg.norm(true_moves[:-1], axis=-1) >= STEP)
    true_turned, seen_turned = _from_the_one_before(true_moves)[turns], _from_the_one_before(seen_moves)[turns]
    pairs["steers"] = [(true_turned.real, seen_turned.real), (true_turned.imag, seen_turned.imag)]
    return {prefix + name: float(np.mean([_correlation(*pair) for pair in some])) for name, some in pairs.items()}


def _from_the_one_before(displacements: np.ndarray) -> np.ndarray:
    """Complex [n - 1, M]: displacements [n, M, 2] along and aside of the direction of the one before, 0 without any."""
    z = displacements[..., 0] + 1j * displacements[..., 1]
    length = np.abs(z[:-1])
    return z[1:] * z[:-1].conj() / np.where(length > 0, length, 1.0)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of true and seen motion, in pixels; nan where the true tool rests, 0 where the seen one
    does."""
    if len(a) < 3 or a.std() < STILL:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1]) if b.std() >= STILL else 0.0


def rows_of(
    variant: str, drive: str, start: int, films: Mapping[str, Film], hz: Mapping[str, float], tools: Mapping[str, int],
    seconds: float,
) -> list[Row]:  # fmt: skip
    """A row per robot and `seconds` of its film; what is left at the end counts if it is half as long."""
    rows: list[Row] = []
    for robot, film in films.items():
        size = max(round(seconds * hz[robot]), 1)
        for i, first in enumerate(range(0, len(film.psnr), size)):
            part = slice(first, min(first + size, len(film.psnr)))
            if 2 * (part.stop - part.start) >= size:
                names = {"variant": variant, "drive": drive, "robot": robot, "start": start}
                rows.append(names | {"part": i + 1, "seconds": seconds} | measure(film, part, tools[robot]))
    return rows


def over_robots(rows: Iterable[Row], name: str) -> tuple[float, float, int]:
    """(mean, half of the 95 % interval by Student's t, n) over robots, of the mean over each one's starts: robots are a
    sample here, and others would differ. (nan, nan, 0) of what no robot has."""
    rows = [row for row in rows if np.isfinite(float(row[name]))]
    robots = dict.fromkeys(row["robot"] for row in rows)
    if not robots:
        return float("nan"), float("nan"), 0
    values = np.array([np.mean([float(row[name]) for row in rows if row["robot"] == robot]) for robot in robots])
    half = critical(len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return float(values.mean()), float(half), len(values)


def read_rows(path: Path) -> list[Row]:
    """What `write_rows` wrote."""

    def value(name: str, text: str) -> object:
        if name in ("variant", "drive", "robot", "kind"):
            return text
        return float(text)

    with path.open(newline="") as file:
        return [{name: value(name, text) for name, text in row.items()} for row in csv.DictReader(file)]
