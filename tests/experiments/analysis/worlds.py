"""Evaluations of which the truth is known: robots, episodes and seeds that share what they share."""

from __future__ import annotations

import numpy as np

from experiments.analysis.intervals import OVERALL, Interval, interval_of, overall
from hma_jax.evaluation.summary import Summary
from hma_jax.evaluation.windows import WindowTable


def intervals(summary: Summary) -> dict[str, dict[str, Interval]]:
    """{robot or OVERALL: {metric: interval}} in closed form, where every robot has every metric."""
    robots = summary.datasets
    found = {robot: {m: interval_of(stat) for m, stat in stats.items()} for robot, stats in robots.items()}
    metrics = next(iter(robots.values()))
    return {OVERALL: {m: overall(stats[m] for stats in robots.values()) for m in metrics}} | found


def judged(
    rng: np.random.Generator,
    *,
    robots: int = 1,
    episodes: int = 12,
    each: int = 4,
    of_episode: float = 1.0,
    of_window: float = 0.5,
    mean: float = 0.0,
) -> WindowTable:
    """A model's loss on `each` windows of every episode, which share a part of it; `mean` in truth."""
    n = robots * episodes * each
    shared = np.repeat(rng.normal(size=robots * episodes), each)
    loss = mean + of_episode * shared + of_window * rng.normal(size=n)
    return WindowTable(
        np.repeat([f"r{i}" for i in range(robots)], episodes * each),
        np.tile(np.repeat(100 + 3 * np.arange(episodes), each), robots),
        np.tile(np.arange(each) * 12, robots * episodes),
        np.full(n, 12),
        {"cross_entropy": loss, "psnr_copy": 20 + shared},
    )


def with_loss(table: WindowTable, loss: np.ndarray) -> WindowTable:
    """The same windows under another model."""
    metrics = {**table.metrics, "cross_entropy": loss}
    return WindowTable(table.dataset, table.episode, table.start, table.frames, metrics)


def under_seeds(
    table: WindowTable, rng: np.random.Generator, seeds: int, of_seed: float, of_both: float = 0.1
) -> dict[int, WindowTable]:
    """The model trained with several seeds, each of which is better or worse on all windows, and by chance on each."""
    loss = table.metrics["cross_entropy"]
    return {
        s: with_loss(table, loss + of_seed * rng.normal() + of_both * rng.normal(size=len(loss))) for s in range(seeds)
    }
