"""Moments of actions, computed part by part; the result is the same to the bit whichever processes computed it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.tokens.beside import beside, read_beside


@dataclass(frozen=True)
class Moments:
    """Count, mean, squared deviations from the mean, smallest and largest of rows, per column.

    Everything is float64 and JSON keeps it exactly. `merge` is not associative in the last
    bits: merge in a fixed order of fixed pieces.
    """

    count: int
    mean: tuple[float, ...]
    square: tuple[float, ...]  # sums of squared deviations from the mean
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def none(cls, dim: int) -> Moments:
        """The moments of no rows."""
        return cls(0, (0.0,) * dim, (0.0,) * dim, (0.0,) * dim, (0.0,) * dim)

    @classmethod
    def of(cls, rows: np.ndarray) -> Moments:
        """The moments of `rows` [N, A]."""
        if not len(rows):
            return cls.none(rows.shape[1])
        rows = rows.astype(np.float64)
        mean = rows.mean(axis=0)
        square = ((rows - mean) ** 2).sum(axis=0)
        parts = (mean, square, rows.min(axis=0), rows.max(axis=0))
        return cls(len(rows), *(tuple(part.tolist()) for part in parts))

    def merge(self, other: Moments) -> Moments:
        """The moments of both sets of rows together."""
        if not (self.count and other.count):
            return self if self.count else other
        total = self.count + other.count
        mean, step = np.asarray(self.mean), np.asarray(other.mean) - np.asarray(self.mean)
        square = np.asarray(self.square) + np.asarray(other.square)
        parts = (
            mean + step * (other.count / total),
            square + step**2 * (self.count * other.count / total),
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )
        return Moments(total, *(tuple(part.tolist()) for part in parts))

    @property
    def std(self) -> tuple[float, ...]:
        """Standard deviations over all rows."""
        return tuple(np.sqrt(np.asarray(self.square) / max(self.count, 1)).tolist())

    @property
    def row(self) -> np.ndarray:
        """float64 [1 + 2 A]: count, means and squares, as `read_moments` gives them of one episode."""
        return np.asarray([self.count, *self.mean, *self.square], np.float64)


def merge_all(pieces: Iterable[Moments], dim: int) -> Moments:
    """The moments of all rows together, merged piece by piece."""
    merged = Moments.none(dim)
    for piece in pieces:
        merged = merged.merge(piece)
    return merged


# --- Moments per episode, so that those of any subset of episodes can be computed ----------------


MOMENTS = "moments"
"""The file beside a part with one row per training episode, in their order."""


def read_moments(part: Path, episodes: int) -> np.ndarray:
    """float64 [episodes, 1 + 2 A]. Raises DataError for a file that is missing or damaged, UnreachableError if the disk
    fails."""
    of, advice = (
        f"the action statistics of {episodes} episodes",
        f"Remove {part.parent} and tokenise the dataset again.",
    )
    found = read_beside(part, MOMENTS, episodes, np.float64, of, advice)
    if found is None:
        raise DataError(f"{beside(part, MOMENTS)}: the file is missing from the token store. {advice}")
    return found


def merge_exactly(rows: np.ndarray, dim: int) -> Moments:
    """The moments of the episodes of `rows` [N, 1 + 2 A]. Sums are rounded once, so that their order does not matter.

    Smallest and largest values are not known: they are 0.
    """
    count, mean, square = rows[:, :1], rows[:, 1 : 1 + dim], rows[:, 1 + dim :]
    total = int(count.sum())
    if not total:
        return Moments.none(dim)
    overall = np.asarray([math.fsum(column) / total for column in (count * mean).T])
    apart = count * (mean - overall) ** 2
    squares = [math.fsum((*a, *b)) for a, b in zip(square.T, apart.T, strict=True)]
    return Moments(total, tuple(overall.tolist()), tuple(squares), (0.0,) * dim, (0.0,) * dim)
