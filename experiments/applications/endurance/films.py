"""Frames of the learned simulator beside those of the true one, under the same actions, and what is measured in each.

All robots advance in one batch. Frames themselves are not kept, but for a few of each to look at. What there is after
every `BLOCK` of frames is kept in a file until the films are whole: half an hour of work survives its process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from experiments.applications.detector import Detector
from experiments.applications.endurance.drives import Drive
from hma_jax.evaluation.metrics import psnr
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.simulator.episode import as_arrays, from_arrays
from hma_jax.simulator.simulator import Simulator

BLOCK = 64
"""Frames that are measured, and kept, together."""

SHOWN = (1, 12, 24, 48, 120, 240, 600, 1200, 1800, 2400, 3600)
"""Frames that are kept to look at, where they are reached."""

BINS = 8
"""Of a colour histogram, per channel."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Film:
    """One robot's n frames, each [n, ...]; P points."""

    psnr: np.ndarray  # dB, the model's against the true frame
    still: np.ndarray  # dB, the start's last frame against the true one
    true_position: np.ndarray  # [n, P, 2], where everything is
    true_share: np.ndarray  # [n, P], how much of it is seen
    position: np.ndarray  # [n, P, 2], where the detector finds it in the model's frames
    confidence: np.ndarray  # [n, P]
    seen_position: np.ndarray  # the same in the true frames
    seen_confidence: np.ndarray
    level: np.ndarray  # mean grey level of the model's frame less that of the true one
    variance: np.ndarray  # of the model's frame over that of the true one
    histogram: np.ndarray  # total variation between colour histograms of `BLOCK` frames of each, in [0, 1]
    shown: np.ndarray  # uint8 [2, k, H, W, 3]: true frames and the model's at `SHOWN`


def make_films(
    simulator: Simulator,
    detector: Detector,
    drives: Sequence[Drive],
    unfinished: Path,
    progress: Progress = lambda done, total: None,
) -> dict[str, Film]:
    """One film for each drive, named by its robot: `simulator` has as many episodes. Goes on from the file
    `unfinished`, where a process that was killed has left it, and comes out as if it never had been."""
    simulator.reset([drive.start for drive in drives], seeds=0)
    begun, parts = _go_on(simulator, drives, unfinished) if unfinished.exists() else (0, [[] for _ in drives])
    images, longest = [simulator.images.copy()], max(map(len, drives))
    points = [drive.points() for drive in drives]
    first = [drive.frames(0, 1)[0] for drive in drives]
    for begin in range(begun, longest, BLOCK):
        stop = min(begin + BLOCK, longest)
        for t in range(begin, stop):
            images.append(simulator.step([d.actions[t] if t < len(d) else None for d in drives]).copy())
            progress(t + 1, longest)
        block = np.stack(images)
        for i, drive in enumerate(drives):
            end = min(stop, len(drive))
            if end > begin:
                film, true = block[: end - begin + 1, i], drive.frames(begin, end + 1)
                parts[i].append(_measured(detector, drive, points[i], begin, film, true, first[i]))
        images = images[-1:]
        _keep(simulator, parts, stop, unfinished)
    return {drive.robot.name: Film(**_joined(mine)) for drive, mine in zip(drives, parts, strict=True)}


def _joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {f.name: np.concatenate([part[f.name] for part in parts], int(f.name == "shown")) for f in fields(Film)}


def _keep(simulator: Simulator, parts: Sequence[Sequence[Mapping[str, np.ndarray]]], frames: int, path: Path) -> None:
    """All that there is of the films after so many frames."""
    arrays = as_arrays(simulator.snapshot()) | {"made": np.array(frames)}
    arrays |= {f"film/{i}/{name}": array for i, mine in enumerate(parts) for name, array in _joined(mine).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, arrays, compressed=False)


def _go_on(
    simulator: Simulator, drives: Sequence[Drive], path: Path
) -> tuple[int, list[list[Mapping[str, np.ndarray]]]]:
    """(frames, parts) as `_keep` left them; the simulator, whose episodes have begun, stands there again. ConfigError
    for a damaged file."""
    with reading_arrays(path, "remove it, the same command films from the start") as arrays:
        parts = [[{f.name: arrays[f"film/{i}/{f.name}"] for f in fields(Film)}] for i in range(len(drives))]
        simulator.restore(from_arrays(arrays, simulator.snapshot()))
        return int(arrays["made"]), parts


def _measured(
    detector: Detector, drive: Drive, points, begin: int, film: np.ndarray, true: np.ndarray, first: np.ndarray
) -> dict[str, np.ndarray]:
    """Of frames begin .. begin + n of both, the first of which was measured before."""
    name, n = drive.robot.name, len(film) - 1
    now, film, true = slice(begin + 1, begin + n + 1), film[1:], true[1:]
    own, seen = detector.detect(name, film), detector.detect(name, true)
    grey, true_grey = film.astype(np.float64), true.astype(np.float64)
    kept = [t - begin - 1 for t in SHOWN if begin < t <= begin + n]
    return {
        "psnr": psnr(film, true), "still": psnr(np.broadcast_to(first, true.shape), true),
        "true_position": points.position[now], "true_share": points.share[now],
        "position": own.position, "confidence": own.confidence,
        "seen_position": seen.position, "seen_confidence": seen.confidence,
        "level": grey.mean((1, 2, 3)) - true_grey.mean((1, 2, 3)),
        "variance": grey.var((1, 2, 3)) / true_grey.var((1, 2, 3)),
        "histogram": np.full(n, 0.5 * np.abs(colours_of(film) - colours_of(true)).sum()),
        "shown": np.stack([true[kept], film[kept]]),
    }  # fmt: skip


def colours_of(images: np.ndarray) -> np.ndarray:
    """Histogram [BINS^3] of the colours of frames uint8 [n, H, W, 3], adding up to 1."""
    levels = (images // (256 // BINS)).reshape(-1, 3).astype(np.int64) @ np.array([BINS**2, BINS, 1])
    return np.bincount(levels, minlength=BINS**3) / len(levels)


def save_films(films: Mapping[str, Film], path: Path) -> None:
    arrays = {f"{robot}/{f.name}": getattr(film, f.name) for robot, film in films.items() for f in fields(Film)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in arrays.items()})


def load_films(path: Path) -> dict[str, Film]:
    """Raises ConfigError for a damaged file."""
    with reading_arrays(path, "remove it, the same command makes it again") as arrays:
        robots = list(dict.fromkeys(name.split("/")[0] for name in arrays))
        return {robot: Film(**{f.name: arrays[f"{robot}/{f.name}"] for f in fields(Film)}) for robot in robots}
