"""Resampling over seeds and episodes: the error of a result for which several seeds were judged on the same windows.

Seeds and episodes are crossed: every seed sees every episode. Both are resampled independently, the episodes within
each robot (Owen 2007, "The pigeonhole bootstrap", Annals of Applied Statistics 1: for crossed effects the error is
never too small, and a little too large if a seed and an episode interact). Of n, n - 1 are drawn with replacement,
which makes the variance of a mean unbiased even for three seeds (Rao and Wu 1988, "Resampling inference with complex
survey data", JASA 83); drawing n would give two thirds of it. The robots are fixed.

All points of a curve are judged on the same windows: one draw takes the same episodes at every point, and the same
seeds if two points have seeds with the same names, so that differences between points, and fits, are paired.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from experiments.analysis.intervals import Interval, critical, satterthwaite
from experiments.analysis.paired import NotComparable, agree, require_same_windows
from hma_jax.config import require
from hma_jax.evaluation.windows import WindowTable

DRAWS = 1000

ROUNDED = 1e-12
"""Share of the largest value: draws that scatter less do so only by rounding, and count as equal."""


@dataclass(frozen=True)
class Panel:
    """One metric of n windows: for each point of a curve a row per seed, [seeds, n]."""

    robot: np.ndarray  # str [n]
    episode: np.ndarray  # int [n]: number within the robot
    points: tuple[np.ndarray, ...]  # float64 [seeds of the point, n]
    seeds: tuple[tuple[int, ...], ...]  # seeds of each point, in the order of its rows

    def __post_init__(self):
        require(len(self.points) == len(self.seeds) > 0, "a panel needs points and their seeds")
        for values, seeds in zip(self.points, self.seeds, strict=True):
            require(len(set(seeds)) == len(seeds) > 0, f"seeds must be given, each once, got {seeds}")
            require(
                values.shape == (len(seeds), len(self.robot)) and len(self.robot) == len(self.episode) > 0,
                f"{len(seeds)} seeds of {len(self.robot)} windows do not have values of shape {values.shape}",
            )

    def rows(self, index: np.ndarray) -> Panel:
        """The panel of some of its windows."""
        return Panel(self.robot[index], self.episode[index], tuple(p[:, index] for p in self.points), self.seeds)

    @property
    def known(self) -> np.ndarray:
        """bool [n]: whether every seed of every point has a value there."""
        return ~np.isnan(np.concatenate(self.points)).any(0)

    def minus(self, other: Panel) -> Panel:
        """Point by point and window by window, over the seeds that both have: a panel of differences.

        Raises NotComparable for different windows, and for points without a common seed.
        """
        same = np.array_equal(self.robot, other.robot) and np.array_equal(self.episode, other.episode)
        if not same or len(self.points) != len(other.points):
            raise NotComparable("panels of different windows or points cannot be subtracted")
        points, names = [], []
        for left, left_seeds, right, right_seeds in zip(
            self.points, self.seeds, other.points, other.seeds, strict=True
        ):
            shared = tuple(s for s in left_seeds if s in right_seeds)
            if not shared:
                raise NotComparable(
                    f"seeds {left_seeds} and {right_seeds} have none in common; run both with the same seeds"
                )
            points.append(left[[left_seeds.index(s) for s in shared]] - right[[right_seeds.index(s) for s in shared]])
            names.append(shared)
        return Panel(self.robot, self.episode, tuple(points), tuple(names))


def make_panel(points: Sequence[dict[int, WindowTable]], metric: str, robots: Sequence[str] | None = None) -> Panel:
    """From {seed: table} of each point, on `robots` (None: those of the first table).

    Raises NotComparable, naming the first window that differs, unless all saw the same windows of them.
    """
    first = next(iter(points[0].values()))
    chosen = first.datasets if robots is None else tuple(robots)
    first = first.among(chosen)
    lacking = [name for name in chosen if name not in first.datasets]
    if lacking:
        raise NotComparable(f"not evaluated: {', '.join(lacking)}")

    def values(table: WindowTable) -> np.ndarray:
        own = table.among(chosen)
        if not agree(first, own):
            shared = require_same_windows(first, table)
            if len(shared) < len(chosen):
                raise NotComparable(f"not evaluated in every trial: {', '.join(sorted(set(chosen) - set(shared)))}")
            own = own.aligned_to(first)
        require(metric in own.metrics, f"a trial has no {metric}; it has {', '.join(own.metrics)}")
        return own.metrics[metric]

    rows = tuple(np.stack([values(table) for table in seeds.values()]) for seeds in points)
    return Panel(first.dataset, first.episode, rows, tuple(tuple(seeds) for seeds in points))


Sums = tuple[np.ndarray, np.ndarray, np.ndarray]
"""(sums of values [all seeds, episodes], windows [episodes], where each robot's episodes end [robots])."""


@dataclass(frozen=True)
class Draws:
    """What resampling makes of each point: `value` [points] as measured, `drawn` [draws, points]."""

    value: np.ndarray
    drawn: np.ndarray


def resample(
    panel: Panel, draws: int = DRAWS, seed: int = 0, *, over_seeds: bool = True, over_episodes: bool = True
) -> Draws:
    """The mean over robots of each point, as measured and in `draws` resamples; a pure function of its arguments.

    A point with one seed keeps it: its draws say nothing about seeds. A robot with one episode cannot be resampled; it
    takes the deviation of another robot, drawn anew each time and scaled to one episode, as in `stratified`.
    """
    return _resample(panel.seeds, _by_episode(panel), draws, seed, over_seeds, over_episodes)


def _resample(
    seeds_of_points: Sequence[tuple[int, ...]],
    by_episode: Sums,
    draws: int,
    seed: int,
    over_seeds: bool,
    over_episodes: bool,
) -> Draws:
    rng = np.random.default_rng(seed)
    sums, counts, ends = by_episode
    value = _mean_of_robots(sums, counts, ends)  # [all seeds of all points]
    if over_episodes:
        episode_weights, rng.bit_generator.state = _episode_weights(tuple(np.diff(ends, prepend=0)), draws, seed)
        drawn = _resample_episodes(sums, counts, ends, episode_weights, rng)
    else:
        drawn = np.tile(value, (draws, 1))
    weights: dict[tuple[int, ...], np.ndarray] = {}
    drawn_means, points, row = [], [], 0
    for seeds in seeds_of_points:
        own = slice(row, row + len(seeds))
        row += len(seeds)
        if seeds not in weights:
            equal = np.full((draws, len(seeds)), 1 / len(seeds))
            weights[seeds] = _weights(len(seeds), draws, rng) if over_seeds else equal
        drawn_means.append((weights[seeds] * drawn[:, own]).sum(1))
        points.append(value[own].mean())
    return Draws(np.asarray(points), np.stack(drawn_means, axis=1))


def bootstrap_intervals(panel: Panel, draws: int = DRAWS, seed: int = 0) -> list[Interval]:
    """For each point the mean, the standard deviation of its draws, and an interval.

    The interval combines those of the two levels, each resampled alone and with its own Student's t: half its width
    squared is (t sem)^2 of the seeds plus (t sem)^2 of the episodes (the method of variance estimates recovery; Zou and
    Donner 2008, Statistics in Medicine 27). Degrees of freedom are the seeds less one, and for episodes
    Satterthwaite's, as of one seed (`intervals.overall`). Three seeds that happen to agree then do not make the
    interval narrow, as they would with quantiles of the draws.
    """
    sums, counts, ends = summed = _by_episode(panel)
    equal = ROUNDED * np.array([np.abs(values).max() for values in panel.points])

    def scatter(over_seeds: bool, over_episodes: bool) -> np.ndarray:
        found = _resample(panel.seeds, summed, draws, seed, over_seeds, over_episodes).drawn.std(0, ddof=1)
        return np.where(found <= equal, 0.0, found)

    both, by_seed, by_episode = scatter(True, True), scatter(True, False), scatter(False, True)
    episodes, value, intervals, row = sums.shape[1], _mean_of_robots(sums, counts, ends), [], 0
    for i, seeds in enumerate(panel.seeds):
        own = slice(row, row + len(seeds))
        row += len(seeds)
        mean = float(value[own].mean())
        # nan, like the interval, if no robot has two episodes
        t_episode = critical(_freedom(sums[own].mean(0), counts, ends))
        t_seed = critical(len(seeds) - 1) if len(seeds) > 1 else 0.0
        half = math.hypot(t_seed * by_seed[i], t_episode * by_episode[i])
        sem = float(both[i]) if episodes > len(ends) else math.nan
        intervals.append(Interval(mean, sem, mean - half, mean + half, len(panel.robot), episodes))
    return intervals


def _by_episode(panel: Panel) -> Sums:
    robots = list(dict.fromkeys(panel.robot.tolist()))
    number = {robot: i for i, robot in enumerate(robots)}
    code = np.asarray([number[r] for r in panel.robot.tolist()])
    # By robot, then by episode; one number is sorted faster than a pair.
    episodes, own = np.unique(panel.episode, return_inverse=True)
    names, which = np.unique(code * len(episodes) + own, return_inverse=True)
    sums = np.stack([np.bincount(which, weights=row, minlength=len(names)) for row in np.concatenate(panel.points)])
    counts = np.bincount(which, minlength=len(names)).astype(np.float64)
    return sums, counts, np.cumsum(np.bincount(names // len(episodes), minlength=len(robots)))


def _mean_of_robots(sums: np.ndarray, counts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    starts = _starts(ends)
    return (np.add.reduceat(sums, starts, axis=1) / np.add.reduceat(counts, starts)).mean(1)


def _starts(ends: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], ends[:-1]])


def _freedom(sums: np.ndarray, counts: np.ndarray, ends: np.ndarray) -> float:
    """Degrees of freedom of the variance that episodes give to the mean over robots, from `sums` [episodes].

    0 if no robot has two episodes, infinite if no two of a robot's differ.
    """
    estimates = []
    for start, end in zip(_starts(ends), ends, strict=True):
        if (freedom := end - start - 1) > 0:
            own_sums, own_counts = sums[start:end], counts[start:end]
            apart = own_sums - own_counts * own_sums.sum() / own_counts.sum()
            variance = (freedom + 1) / freedom * (apart**2).sum() / own_counts.sum() ** 2
            estimates.append((float(variance), int(freedom)))
    return satterthwaite(estimates) if estimates else 0.0


def _resample_episodes(
    sums: np.ndarray, counts: np.ndarray, ends: np.ndarray, weights: Sequence[np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """[draws, all seeds]: the mean over robots, each with different episodes in every draw."""
    means, known, alone, draws = [], [], [], len(weights[0])
    for start, end, weight in zip(_starts(ends), ends, weights, strict=True):
        own_sums, own_counts = sums[:, start:end], counts[start:end]
        measured = own_sums.sum(1) / own_counts.sum()
        if end - start == 1:
            alone.append(len(means))
            means.append(np.tile(measured, (draws, 1)))
            continue
        drawn = weight @ own_sums.T / (weight @ own_counts)[:, None]
        known.append((drawn - measured) * math.sqrt(end - start))  # robots with one episode
        means.append(drawn)
    if known:
        deviations = np.stack(known)
        for i in alone:
            means[i] = means[i] + deviations[rng.integers(len(known), size=draws), rng.permutation(draws)]
    return np.mean(means, axis=0)


@lru_cache(maxsize=8)
def _episode_weights(counts: tuple[int, ...], draws: int, seed: int) -> tuple[tuple[np.ndarray, ...], dict[str, Any]]:
    """The weights of each robot's episodes (`counts`: how many it has), and the state of their generator afterwards.

    They are cached: all metrics and pairs of models that are judged on the same windows share them, and drawing them
    takes longer than using them."""
    rng = np.random.default_rng(seed)
    weights = tuple(_weights(count, draws, rng) for count in counts)
    return weights, rng.bit_generator.state


def _weights(n: int, draws: int, rng: np.random.Generator) -> np.ndarray:
    """[draws, n], rows of sum 1: how often each is among n - 1 drawn with replacement; one alone is always drawn."""
    if n == 1:
        return np.ones((draws, 1))
    return rng.multinomial(n - 1, np.full(n, 1 / n), size=draws) / (n - 1)
