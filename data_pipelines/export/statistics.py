"""The statistics in a LeRobot dataset, of each episode and of all: policies scale values by them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

Statistics = Mapping[str, np.ndarray]
"""Statistics of one feature: min, max, mean and std, each of the feature's shape ([3, 1, 1] for a camera, of values
from 0 to 1), count [1], and for vectors also the QUANTILES."""

COMBINED = ("min", "max", "mean", "std", "count")
"""What `combine` gives."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def of_values(rows: np.ndarray) -> Statistics:
    """Statistics of rows [N, size]."""
    rows = np.asarray(rows, np.float64)
    moments = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return {**moments, "count": np.array([len(rows)]), **quantiles(rows)}


def quantiles(rows: np.ndarray) -> Statistics:
    """The QUANTILES of rows [N, size]."""
    return dict(zip(QUANTILES, np.quantile(rows, list(QUANTILES.values()), axis=0), strict=True))


class PixelCounts:
    """How often each value of each channel occurs in the frames that were added."""

    def __init__(self) -> None:
        self._counts, self._frames = np.zeros((3, 256), np.int64), 0

    def add(self, frame: np.ndarray) -> None:
        """`frame`: uint8 [H, W, 3]."""
        self._frames += 1
        for channel in range(3):
            self._counts[channel] += np.bincount(frame[..., channel].ravel(), minlength=256)

    def statistics(self) -> Statistics:
        values, shares = np.arange(256) / 255, self._counts / self._counts.sum(1, keepdims=True)
        mean = shares @ values
        moments = {
            "min": np.array([values[counts > 0][0] for counts in self._counts]),
            "max": np.array([values[counts > 0][-1] for counts in self._counts]),
            "mean": mean,
            "std": np.sqrt(np.maximum(shares @ values**2 - mean**2, 0)),
        }
        return {**{name: value.reshape(3, 1, 1) for name, value in moments.items()}, "count": np.array([self._frames])}


def combine(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of all values together, given those of each part; quantiles cannot be combined."""
    count = np.array([int(part["count"][0]) for part in parts])
    stacked = {name: np.stack([np.asarray(part[name], np.float64) for part in parts]) for name in ("mean", "std")}
    mean = np.average(stacked["mean"], axis=0, weights=count)
    square = np.average(stacked["std"] ** 2 + stacked["mean"] ** 2, axis=0, weights=count)
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(np.maximum(square - mean**2, 0)),
        "count": np.array([count.sum()]),
    }
