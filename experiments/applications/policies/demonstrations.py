"""Recorded episodes as arrays, on which policies and success heads are trained."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from experiments.applications.policies.driving import ExpertRollouts, drive, new_episodes
from experiments.applications.policies.tasks import Task, held, join
from hma_jax.config import require
from hma_jax.runtime.arrays import reading_arrays, write_arrays

SPLIT = "demonstrations"
"""Their seeds differ from those of all episodes on which a world model is trained or judged."""


@dataclass(frozen=True)
class Demonstrations:
    """N episodes of up to L frames, padded by zeros. Action t is given at frame t and held until the next.

    images uint8 [N, L, H, W, 3], actions float32 [N, L, A] in raw units, lengths int [N] (frames that count),
    reached bool [N, L] (the goal is reached at this frame), successes bool [N] (`Task.hold` frames in a row),
    seeds int64 [N] (with which their true simulator begins them; -1: there is none).
    """

    images: np.ndarray
    actions: np.ndarray
    lengths: np.ndarray
    reached: np.ndarray
    successes: np.ndarray
    seeds: np.ndarray

    def __post_init__(self):
        shape = self.images.shape[:2]
        require(
            self.images.dtype == np.uint8 and self.actions.shape[:2] == shape and self.reached.shape == shape
            and len(self.lengths) == len(self.successes) == len(self.seeds) == shape[0],
            f"the arrays of demonstrations have different numbers of episodes or frames: images {self.images.shape}, "
            f"actions {self.actions.shape}, reached {self.reached.shape}",
        )  # fmt: skip

    def __len__(self) -> int:
        """N."""
        return len(self.images)

    def take(self, rows: np.ndarray | slice | Sequence[int]) -> Demonstrations:
        """A selection of the episodes."""
        return Demonstrations(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """(episodes, frames) of all n frames that count, int [n] each."""
        return np.nonzero(np.arange(self.images.shape[1]) < self.lengths[:, None])


def record(
    task: Task,
    count: int,
    *,
    stride: int = 1,
    image_size: int = 64,
    noise: float | Sequence[float] = 0.2,
    play: bool = False,
    after: int | None = None,
    only_successes: bool = False,
    seed: int = 0,
) -> Demonstrations:
    """`count` episodes of the scripted expert, of `task.frames` frames each; a pure function of the arguments.

    Several `noise` values get equal shares. The actions are the imprecise ones that were executed. `play`: restless
    behaviour instead of the expert. `after`: an episode ends this many frames after it succeeded (None: at its full
    length). `only_successes` leaves failures out; episodes are then drawn until there are enough. Raises ConfigError
    for numbers that cannot be, and if the expert hardly ever succeeds.
    """
    noises = np.atleast_1d(noise).tolist()
    require(count >= 1 and stride >= 1, f"count and stride must be at least 1, got {count} and {stride}")
    require(after is None or after >= 0, f"after must not be negative, got {after}")
    require(
        bool(noises) and all(0 <= level < math.inf for level in noises),
        f"noise must be one or more finite numbers that are not negative, got {noise}",
    )
    counts = [count // len(noises) + (i < count % len(noises)) for i in range(len(noises))]
    parts, first = [], 0
    for level, wanted in zip(noises, counts, strict=True):
        found = 0
        for _ in range(50):
            if found >= wanted:
                break
            seeds = new_episodes(task, first + wanted, seed, SPLIT)[first:]
            first += wanted
            driven = drive(task, seeds, stride, image_size, noise=level, play=play)
            made = _finished(task, driven, seeds, after)
            made = made.take(np.flatnonzero(made.successes)) if only_successes else made
            parts.append(made.take(slice(wanted - found)))
            found += len(parts[-1])
        require(
            found >= wanted,
            f"{task.robot}: the scripted expert with noise {level:g} succeeds too rarely to record {wanted} episodes",
        )
    return join(parts)


def _finished(task: Task, driven: ExpertRollouts, seeds: np.ndarray, after: int | None) -> Demonstrations:
    images, acted, done = driven
    solved, (n, frames) = held(done, task.hold), done.shape
    lengths = np.full(n, frames)
    if after is not None:
        lengths = np.minimum(lengths, np.where(solved.any(1), solved.argmax(1) + 1 + after, frames))
        gone = np.arange(frames) >= lengths[:, None]
        images[gone], acted[gone], done[gone] = 0, 0, False
    return Demonstrations(images, acted, lengths, done, solved.any(1), np.asarray(seeds, np.int64))


def save_demonstrations(demos: Demonstrations, path: Path | str) -> None:
    """Writes the demonstrations, compressed, completely or not at all."""
    write_arrays(path, vars(demos))


def load_demonstrations(path: Path | str) -> Demonstrations:
    """What `save_demonstrations` wrote. Raises ConfigError for a file that is damaged or something else."""
    with reading_arrays(path, "record them again") as arrays:
        return Demonstrations(**{f.name: arrays[f.name] for f in fields(Demonstrations)})
