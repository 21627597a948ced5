"""Losses on curves whose coefficients are known, with the noise of seeds and of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from experiments.analysis.bootstrap import Panel, resample
from experiments.analysis.measured import Measurements

DATASETS, EPISODES = 10, 8


def measured(
    x: np.ndarray, loss: np.ndarray, noise: float, seeds: int, rng: np.random.Generator, episode_noise: float = 0.3
) -> Measurements:
    """`seeds` trials at each of `x` [m, K] with the expected `loss` [m]; each seed is off by `noise` in the logarithm.

    Episodes are harder and easier by `episode_noise`, the same ones for every trial.
    """
    x, loss = np.repeat(x, seeds, 0), np.repeat(loss, seeds)
    loss = loss * np.exp(noise * rng.standard_normal(len(loss)))
    hard = np.exp(episode_noise * rng.standard_normal(DATASETS * EPISODES))
    values = loss[:, None] * (hard / hard.mean() + 0.01 * rng.standard_normal((len(loss), len(hard))))
    robot, episode = np.repeat([f"robot{d}" for d in range(DATASETS)], EPISODES), np.tile(np.arange(EPISODES), DATASETS)
    names = tuple((i % seeds,) for i in range(len(x)))
    panel = Panel(robot, episode, tuple(row[None] for row in values), names)
    return Measurements(
        ("trunk parameters", "windows")[: x.shape[1]], x,
        run=np.array([f"{row[0]:.0f}" for row in x]), trial=tuple(f"t{i}" for i in range(len(x))),
        seed=np.array([seed for (seed,) in names]),
        value=resample(panel, 1, over_seeds=False, over_episodes=False).value, panel=panel,
    )  # fmt: skip


def of_one_run(x: np.ndarray | Sequence, seed: Sequence[int], value: Sequence[float]) -> Measurements:
    """Losses [n] of branches of one run at `x` [n] or [n, K], as they are: without windows that they are means of."""
    x, trials = np.array(x, float).reshape(len(x), -1), tuple(f"t{i}" for i in range(len(x)))
    names, run = ("trunk parameters", "windows")[: x.shape[1]], np.array(["run"] * len(x))
    return Measurements(names, x, run, trials, np.array(seed), np.array(value), None)


def scaled(points: Measurements, factors: dict[int, float]) -> Measurements:
    """The same, the losses of some trials times a factor."""
    by = np.array([factors.get(i, 1.0) for i in range(len(points.trial))])
    values = tuple(values * factor for values, factor in zip(points.panel.points, by, strict=True))
    return replace(points, value=points.value * by, panel=replace(points.panel, points=values))


def only(points: Measurements, chosen: np.ndarray) -> Measurements:
    """The trials where `chosen` [n] holds."""
    at = np.flatnonzero(chosen)
    values, seeds = (tuple(column[i] for i in at) for column in (points.panel.points, points.panel.seeds))
    return replace(
        points, x=points.x[at], run=points.run[at], trial=tuple(points.trial[i] for i in at), seed=points.seed[at],
        value=points.value[at], panel=replace(points.panel, points=values, seeds=seeds),
    )  # fmt: skip


def sizes(count: int, span: float = 30.0) -> np.ndarray:
    """[count, 1] from 1e4 on."""
    return np.geomspace(1e4, span * 1e4, count)[:, None]


def power(x: np.ndarray, e: float, *terms: tuple[float, float]) -> np.ndarray:
    """e + sum of a (x_k / 1e4)^-alpha for (a, alpha) of `terms`."""
    return e + sum(a * (column / 1e4) ** -alpha for (a, alpha), column in zip(terms, x.T, strict=True))
