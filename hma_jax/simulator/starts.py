"""Recorded beginnings of episodes, from which a simulator starts, and their file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hma_jax.config import require
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.simulator.robots import real_numbers

FILE = "starts.npz"


@dataclass(frozen=True, eq=False)
class Start:
    """The first n frames of an episode at the model's rate, and all native actions between them."""

    robot: str
    images: np.ndarray  # uint8 [n, H, W, 3]
    actions: np.ndarray  # float32 [(n - 1) stride, A], raw
    seed: int | None = None  # the seed with which the robot's true simulator begins the same episode

    def __post_init__(self):
        object.__setattr__(self, "images", np.asarray(self.images))
        object.__setattr__(self, "actions", real_numbers(self.actions, f"a start of {self.robot}: `actions`"))
        require(
            self.images.dtype == np.uint8 and self.images.ndim == 4 and len(self.images) >= 1,
            f"a start of {self.robot} needs images uint8 [n, H, W, 3], got {self.images.dtype} {self.images.shape}",
        )
        require(
            self.actions.ndim == 2 and bool(np.isfinite(self.actions).all()),
            f"a start of {self.robot} needs finite actions [(n - 1) stride, A], got {self.actions.shape}",
        )

    def __eq__(self, other: object) -> bool:
        """Equal in all values; a dataclass would compare arrays, whose `==` is not a bool."""
        if not isinstance(other, Start):
            return NotImplemented
        same = self.robot == other.robot and self.seed == other.seed
        return same and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("images", "actions"))

    def __hash__(self) -> int:
        return hash((self.robot, self.seed, self.images.tobytes()))


def save_starts(starts: Sequence[Start], path: Path | str) -> None:
    """Writes all starts, compressed, or nothing."""
    arrays: dict[str, np.ndarray] = {}
    for i, start in enumerate(starts):
        seed = [] if start.seed is None else [start.seed]
        for name, value in (("images", start.images), ("actions", start.actions), ("seed", np.array(seed, np.int64))):
            arrays[f"{i:04d}/{start.robot}/{name}"] = value
    write_arrays(path, arrays)


def load_starts(path: Path | str) -> tuple[Start, ...]:
    """Reads what `save_starts` wrote. Raises ConfigError for a file that is damaged or of another kind."""
    with reading_arrays(path, "make it again") as arrays:
        starts = []
        for number, robot in sorted({_parts(name) for name in arrays}):
            name = f"{number:04d}/{robot}"
            seed = arrays[f"{name}/seed"]
            images, actions = arrays[f"{name}/images"], arrays[f"{name}/actions"]
            starts.append(Start(robot, images, actions, int(seed[0]) if len(seed) else None))
        return tuple(starts)


def _parts(name: str) -> tuple[int, str]:
    """A start's number and robot, from the name of one of its arrays. A robot's name may contain "/" too."""
    number, rest = name.split("/", 1)
    return int(number), rest.rsplit("/", 1)[0]
