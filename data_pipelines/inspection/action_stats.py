"""Statistics of an action field, value by value, and hints at their meaning.

Hints are guesses from the statistics, for a person to check: they never change how data are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.registry.angles import RECOGNISED, SWITCH_SHARE, AngleUnit, count_jumps, find_turns
from data_pipelines.tokens.row_sample import QUANTILES
from hma_jax.model.embodiments import DEAD_STD

WRAPPING: dict[AngleUnit, str] = dict(zip(RECOGNISED, ("wrapping angle", "wrapping angle in degrees"), strict=True))
"""Hints for angles, by their unit."""


BINS = 24
"""Bins of the histogram, from the smallest value to the largest."""


@dataclass(frozen=True)
class DimensionFacts:
    """One value of an action field over all sampled steps."""

    minimum: float
    maximum: float
    mean: float
    std: float
    distinct: int  # number of different values, counted up to 100
    smoothness: float  # step-to-step change relative to that of independent values; nan for a constant
    not_finite: int
    quantiles: tuple[float, ...]  # at QUANTILES
    histogram: tuple[int, ...]  # values in BINS equal bins
    hint: str  # constant, end flag, switch, one of WRAPPING, absolute, delta, or nothing
    broken: tuple[int, ...] = ()  # numbers, from 0, of sampled episodes with a step in which it is not finite


def dimension_facts(episodes: Sequence[np.ndarray]) -> tuple[DimensionFacts, ...]:
    """Facts per value of `episodes`, each [N, A] of one dataset."""
    width = episodes[0].shape[1] if episodes else 0
    return tuple(_one([rows[:, d].astype(np.float64) for rows in episodes]) for d in range(width))


def _one(columns: list[np.ndarray]) -> DimensionFacts:
    values = np.concatenate(columns)
    finite = np.isfinite(values)
    good = values[finite]
    broken = tuple(i for i, column in enumerate(columns) if not np.isfinite(column).all())
    if not len(good):
        nan, none = float("nan"), (0,) * BINS
        return DimensionFacts(nan, nan, nan, nan, 0, nan, len(values), (nan,) * len(QUANTILES), none, "", broken)
    mean, std = float(good.mean()), float(good.std())
    columns = [kept for column in columns if len(kept := column[np.isfinite(column)])]
    changes = np.concatenate([np.diff(column) for column in columns])
    alive = std > DEAD_STD and len(changes)
    # Independent draws change by sqrt(2) standard deviations from one step to the next.
    smoothness = float(np.sqrt((changes**2).mean()) / (np.sqrt(2) * std)) if alive else float("nan")
    counts = np.sort(np.unique(good, return_counts=True)[1])
    distinct = min(len(counts), 100)
    hint = _hint(columns, mean, std, counts[-2:].sum() / len(good), smoothness)
    extremes = float(good.min()), float(good.max())
    quantiles = tuple(np.quantile(good, QUANTILES, method="inverted_cdf").tolist())
    # Relative to the smallest value: between large numbers, such as nanoseconds, floats may be too coarse for bin
    # edges.
    span = (0.0, extremes[1] - extremes[0]) if alive else (-1.0, 1.0)
    histogram = tuple(np.histogram(good - extremes[0], BINS, span)[0].tolist())
    bad = int((~finite).sum())
    return DimensionFacts(*extremes, mean, std, distinct, smoothness, bad, quantiles, histogram, hint, broken)


def _hint(columns: list[np.ndarray], mean: float, std: float, commonest: float, smoothness: float) -> str:
    """`commonest`: share of the two most frequent numbers."""
    if std <= DEAD_STD:
        return "constant"
    if commonest >= SWITCH_SHARE:
        ends = all(not column[:-1].any() for column in columns) and any(column[-1] for column in columns)
        return "end flag" if ends else "switch"
    for unit, words in WRAPPING.items():
        if _wraps(columns, unit):
            return words
    # Absolute targets drift slowly around the robot's position; changes jump around zero.
    if smoothness < 0.2 or abs(mean) > 2 * std:
        return "absolute"
    return "delta" if abs(mean) < 0.5 * std else ""


def _wraps(columns: list[np.ndarray], unit: AngleUnit) -> bool:
    low, high = np.array(min(c.min() for c in columns)), np.array(max(c.max() for c in columns))
    return bool(find_turns(low, high, sum(count_jumps(c, unit) for c in columns), unit))
