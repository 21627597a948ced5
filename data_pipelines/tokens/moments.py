"""Statistics of actions that come in pieces, and whose bits do not depend on who added them up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


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
        """Of no rows."""
        return cls(0, (0.0,) * dim, (0.0,) * dim, (0.0,) * dim, (0.0,) * dim)

    @classmethod
    def of(cls, rows: np.ndarray) -> Moments:
        """Of `rows` [N, A], at least one."""
        rows = rows.astype(np.float64)
        mean = rows.mean(axis=0)
        square = ((rows - mean) ** 2).sum(axis=0)
        parts = (mean, square, rows.min(axis=0), rows.max(axis=0))
        return cls(len(rows), *(tuple(part.tolist()) for part in parts))

    def merge(self, other: Moments) -> Moments:
        """Of the rows of both."""
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


def merge_all(pieces: Iterable[Moments], dim: int) -> Moments:
    """Of the rows of all, merged one after the other."""
    merged = Moments.none(dim)
    for piece in pieces:
        merged = merged.merge(piece)
    return merged
