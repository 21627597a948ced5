"""Tables of films: a row of measures per robot and minute, and means over robots with intervals."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from experiments.analysis.intervals import critical
from experiments.applications.detector import CLOSE_PX, MIN_CONFIDENCE, SURE_CONFIDENCE
from experiments.applications.endurance.films import Film
from experiments.applications.scenes import VISIBLE_SHARE

MIN_MOTION = 1e-3
"""A displacement counts as no motion if its standard deviation, in pixels, is less than this."""

MIN_STEP = 1.0
"""Pixels: the direction of a shorter displacement is not used."""

Row = dict[str, object]

MEASURES = (
    "psnr", "psnr_still", "tool_found", "tool_close", "tool_px", "object_found", "object_close", "object_px", "follows",
    "moves", "steers", "true_tool_close", "true_object_close", "true_follows", "true_moves", "true_steers", "level",
    "variance", "histogram", "tool_sure", "object_sure",
)  # fmt: skip


def measure(film: Film, part: slice, tools: int) -> dict[str, float]:
    """`MEASURES` of the frames `part` of a film whose first `tools` points are tools, over truly visible points."""
    measures: dict[str, float] = {"psnr": film.psnr[part].mean(), "psnr_still": film.still[part].mean()}
    visible = film.true_share[part] >= VISIBLE_SHARE
    for name, position, confidence in (
        ("", film.position, film.confidence), ("true_", film.seen_position, film.seen_confidence),
    ):  # fmt: skip
        error = np.linalg.norm(position[part] - film.true_position[part], axis=-1)
        confident = confidence[part] >= MIN_CONFIDENCE
        for kind, which in (("tool", slice(None, tools)), ("object", slice(tools, None))):
            kind_visible = visible[:, which]
            distances, detected = error[:, which][kind_visible], confident[:, which][kind_visible]
            measures |= {
                f"{name}{kind}_found": detected.mean(), f"{name}{kind}_close": (detected & (distances <= CLOSE_PX)).mean(),
                f"{name}{kind}_px": np.median(distances),
            }  # fmt: skip
    sure = film.confidence[part] >= SURE_CONFIDENCE
    for kind, which in (("tool", slice(None, tools)), ("object", slice(tools, None))):
        measures[f"{kind}_sure"] = sure[:, which][visible[:, which]].mean()
    for name, position in (("", film.position), ("true_", film.seen_position)):
        measures |= motion(film.true_position[part, :tools], position[part, :tools], visible[:, :tools], name)
    measures |= {name: getattr(film, name)[part].mean() for name in ("level", "variance", "histogram")}
    return {name: float(measures[name]) for name in MEASURES}


def motion(true: np.ndarray, seen: np.ndarray, visible: np.ndarray, prefix: str) -> dict[str, float]:
    """Pearson's correlations of detected displacements of tools [n, M, 2] with the true ones, from frame to frame while
    a tool is in view: `follows`, mean over image axes; `moves`, of their lengths; `steers`, mean over the components
    along and across the previous displacement. The last two do not depend on the robot's heading, which differs from
    the true one after the first error if commands are velocities in the robot's own frame."""
    both = visible[1:] & visible[:-1]
    true_moves, seen_moves = np.diff(true, axis=0), np.diff(seen, axis=0)
    pairs = {"follows": [(true_moves[both][:, a], seen_moves[both][:, a]) for a in (0, 1)]}
    pairs["moves"] = [(np.linalg.norm(true_moves[both], axis=-1), np.linalg.norm(seen_moves[both], axis=-1))]
    turns = both[1:] & both[:-1] & (np.linalg.norm(true_moves[:-1], axis=-1) >= MIN_STEP)
    true_turned, seen_turned = _relative_to_previous(true_moves)[turns], _relative_to_previous(seen_moves)[turns]
    pairs["steers"] = [(true_turned.real, seen_turned.real), (true_turned.imag, seen_turned.imag)]
    return {prefix + name: float(np.mean([_correlation(*pair) for pair in some])) for name, some in pairs.items()}


def _relative_to_previous(displacements: np.ndarray) -> np.ndarray:
    """Complex [n - 1, M]: displacements [n, M, 2] along (real) and across (imaginary) the previous one; 0 if the
    previous one is 0."""
    z = displacements[..., 0] + 1j * displacements[..., 1]
    length = np.abs(z[:-1])
    return z[1:] * z[:-1].conj() / np.where(length > 0, length, 1.0)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of true and seen motion, in pixels; nan if the true tool rests, 0 if the seen one does."""
    if len(a) < 3 or a.std() < MIN_MOTION:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1]) if b.std() >= MIN_MOTION else 0.0


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
    """(mean, half of the 95 % interval by Student's t, n) over robots, of the mean over each robot's starts: robots are
    a sample here, and other robots would differ. (nan, nan, 0) if no robot has the measure."""
    rows = [row for row in rows if np.isfinite(float(row[name]))]
    robots = dict.fromkeys(row["robot"] for row in rows)
    if not robots:
        return float("nan"), float("nan"), 0
    values = np.array([np.mean([float(row[name]) for row in rows if row["robot"] == robot]) for robot in robots])
    half = critical(len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return float(values.mean()), float(half), len(values)


def read_rows(path: Path) -> list[Row]:
    """What `write_rows` wrote."""
    texts = ("variant", "drive", "robot", "kind")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [{name: text if name in texts else float(text) for name, text in row.items()} for row in rows]
