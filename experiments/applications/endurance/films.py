"""Rollouts of the learned and the true simulator under the same actions, and what is measured in their frames.

All robots advance in one batch. Frames are not kept, except a few of each robot to look at. Progress is saved after
every `BLOCK` of frames until the films are complete, since they take half an hour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from data_pipelines.sources.rlds.images import fit_images
from experiments.applications.detector import Detector, enlarged
from experiments.applications.endurance.drives import Drive
from hma_jax.evaluation.metrics import psnr
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.simulator.episode import as_arrays, from_arrays
from hma_jax.simulator.simulator import Simulator

BLOCK = 64
"""Number of frames that are measured together, and after which progress is saved."""

SHOWN = (1, 12, 24, 48, 120, 240, 600, 1200, 1800, 2400, 3600)
"""Frames that are kept to look at, where they are reached."""

BINS = 8
"""Bins of a colour histogram, per channel."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Film:
    """Measures of one robot's n frames, each [n, ...]; P points."""

    psnr: np.ndarray  # dB, the model's against the true frame
    still: np.ndarray  # dB, the start's last frame against the true one
    true_position: np.ndarray  # [n, P, 2], from the true state
    true_share: np.ndarray  # [n, P], how much of the point is in view
    position: np.ndarray  # [n, P, 2], detected in the model's frames
    confidence: np.ndarray  # [n, P]
    seen_position: np.ndarray  # [n, P, 2], detected in the true frames
    seen_confidence: np.ndarray
    level: np.ndarray  # mean grey level of the model's frame minus that of the true one
    variance: np.ndarray  # of the model's frame, divided by that of the true one
    histogram: np.ndarray  # total variation between colour histograms of `BLOCK` frames of each, in [0, 1]
    shown: np.ndarray  # uint8 [2, k, H, W, 3]: true frames and the model's at `SHOWN`


def make_films(
    simulator: Simulator,
    detector: Detector,
    drives: Sequence[Drive],
    unfinished: Path,
    progress: Progress = lambda done, total: None,
) -> dict[str, Film]:
    """One film for each drive, by the name of its robot; `simulator` has one episode for each. Resumes from the file
    `unfinished` if a killed process left it; the films are the same as without the kill."""
    simulator.reset([drive.start for drive in drives], seeds=0)
    first_frame, parts = _resume(simulator, drives, unfinished) if unfinished.exists() else (0, [[] for _ in drives])
    images, longest = [simulator.images.copy()], max(map(len, drives))
    points = [drive.points() for drive in drives]
    size = simulator.tokenizer.image_size
    start_frames = [fit_images(drive.frames(0, 1), size)[0] for drive in drives]
    for start in range(first_frame, longest, BLOCK):
        stop = min(start + BLOCK, longest)
        for t in range(start, stop):
            images.append(simulator.step([d.actions[t] if t < len(d) else None for d in drives]).copy())
            progress(t + 1, longest)
        block = np.stack(images)
        for i, drive in enumerate(drives):
            end = min(stop, len(drive))
            if end > start:
                film, true = block[: end - start + 1, i], fit_images(drive.frames(start, end + 1), size)
                parts[i].append(_measure_block(detector, drive, points[i], start, film, true, start_frames[i]))
        images = images[-1:]
        _save_progress(simulator, parts, stop, unfinished)
    return {drive.robot.name: Film(**_join(blocks)) for drive, blocks in zip(drives, parts, strict=True)}


def _join(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {f.name: np.concatenate([part[f.name] for part in parts], int(f.name == "shown")) for f in fields(Film)}


def _save_progress(
    simulator: Simulator, parts: Sequence[Sequence[Mapping[str, np.ndarray]]], frames: int, path: Path
) -> None:
    """Writes the state of the simulator and the measures of the first `frames` frames."""
    arrays = as_arrays(simulator.snapshot()) | {"made": np.array(frames)}
    arrays |= {f"film/{i}/{name}": array for i, blocks in enumerate(parts) for name, array in _join(blocks).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, arrays, compressed=False)


def _resume(
    simulator: Simulator, drives: Sequence[Drive], path: Path
) -> tuple[int, list[list[Mapping[str, np.ndarray]]]]:
    """(frames done, measures of each film) as `_save_progress` wrote them; restores the simulator, which has been
    reset. ConfigError for a damaged file."""
    with reading_arrays(path, "remove it; the same command then films from the start") as arrays:
        parts = [[{f.name: arrays[f"film/{i}/{f.name}"] for f in fields(Film)}] for i in range(len(drives))]
        simulator.restore(from_arrays(arrays, simulator.snapshot()))
        return int(arrays["made"]), parts


def _measure_block(
    detector: Detector, drive: Drive, points, start: int, film: np.ndarray, true: np.ndarray, start_frame: np.ndarray
) -> dict[str, np.ndarray]:
    """The measures of frames start + 1 .. start + n; `film` and `true` include the frame before these."""
    name, n = drive.robot.name, len(film) - 1
    now, film, true = slice(start + 1, start + n + 1), film[1:], true[1:]
    detected, detected_true = (detector.detect(name, enlarged(images)) for images in (film, true))
    grey, true_grey = film.astype(np.float64), true.astype(np.float64)
    kept = [t - start - 1 for t in SHOWN if start < t <= start + n]
    return {
        "psnr": psnr(film, true), "still": psnr(np.broadcast_to(start_frame, true.shape), true),
        "true_position": points.position[now], "true_share": points.share[now],
        "position": detected.position, "confidence": detected.confidence,
        "seen_position": detected_true.position, "seen_confidence": detected_true.confidence,
        "level": grey.mean((1, 2, 3)) - true_grey.mean((1, 2, 3)),
        "variance": grey.var((1, 2, 3)) / true_grey.var((1, 2, 3)),
        "histogram": np.full(n, 0.5 * np.abs(colour_histogram(film) - colour_histogram(true)).sum()),
        "shown": np.stack([true[kept], film[kept]]),
    }  # fmt: skip


def colour_histogram(images: np.ndarray) -> np.ndarray:
    """Histogram [BINS^3] of the colours of frames uint8 [n, H, W, 3], adding up to 1."""
    levels = (images // (256 // BINS)).reshape(-1, 3).astype(np.int64) @ np.array([BINS**2, BINS, 1])
    return np.bincount(levels, minlength=BINS**3) / len(levels)


def save_films(films: Mapping[str, Film], path: Path) -> None:
    arrays = {f"{robot}/{f.name}": getattr(film, f.name) for robot, film in films.items() for f in fields(Film)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in arrays.items()})


def load_films(path: Path) -> dict[str, Film]:
    """Loads films. Raises ConfigError for a damaged file."""
    with reading_arrays(path, "remove it; the same command then makes it again") as arrays:
        robots = list(dict.fromkeys(name.split("/")[0] for name in arrays))
        return {robot: Film(**{f.name: arrays[f"{robot}/{f.name}"] for f in fields(Film)}) for robot in robots}
