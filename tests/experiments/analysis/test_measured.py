"""Losses of seeds that are judged on other robots each: what taking their levels out leaves of how they scatter."""

from collections.abc import Sequence

import numpy as np
import pytest
import scipy.stats

from experiments.analysis.fits import fit_power
from experiments.analysis.measured import Measurements, Position, measure
from hma_jax.evaluation.windows import WindowTable
from tests.experiments.analysis.curves import power, sizes

POINTS, SEEDS, NOISE, HARD = 4, 3, 0.004, 0.3
X = sizes(POINTS, span=8.0)
LOSS = power(X, 1.5, (1.0, 0.9))


def levelled(
    rng: np.random.Generator, lacking: Sequence[tuple[int, int]] = (), loss: np.ndarray = LOSS
) -> Measurements:
    """Trials on one curve of `loss` [POINTS], each seed judged on a robot of its own; without those of (point, seed) in
    `lacking`."""
    hard = np.exp(HARD * rng.standard_normal(SEEDS))
    places, tables = [], {}
    for point, x in enumerate(X[:, 0]):
        for seed in range(SEEDS):
            nats = loss[point] * hard[seed] * np.exp(NOISE * rng.standard_normal())
            if (point, seed) in lacking:
                continue
            robot, zero = f"robot{seed}", np.zeros(1, int)
            places.append(Position(f"{point}-{seed}", str(point), seed, (x,), (robot,)))
            tables[f"{point}-{seed}"] = WindowTable(
                np.array([robot]), zero, zero, zero + 4, {"cross_entropy": np.array([nats])}
            )
    return measure(("trunk parameters",), places, tables)


def test_taking_levels_out_leaves_the_spread_of_seeds_as_it_is():
    """Of noise, and of the mean of a position in draws; without the degrees of freedom that levels took both are
    3/4."""
    rng, noise, drawn = np.random.default_rng(0), [], []
    for _ in range(120):
        points = levelled(rng)
        assert points.freedom == (POINTS - 1) * (SEEDS - 1)
        noise.append(np.mean(points.noise() ** 2) / NOISE**2)
        means = np.log(points.draw(30, rng)).reshape(30, POINTS, SEEDS).mean(2)
        drawn.append(np.mean(means.var(0, ddof=1)) / (NOISE**2 / SEEDS))
    assert np.mean(noise) == pytest.approx(1, abs=0.16)  # three standard deviations of 120 tries
    assert np.mean(drawn) == pytest.approx(1, abs=0.16)


def test_a_lack_of_fit_is_judged_by_the_scatter_that_levels_leave():
    points = levelled(np.random.default_rng(0), loss=LOSS * [1, 1.02, 1, 1.02])
    fit = fit_power(points, 2)
    of_point = fit.residuals.reshape(POINTS, SEEDS)
    mean, free = of_point.mean(1), (POINTS - 1) * (SEEDS - 1)
    ratio = SEEDS * np.sum(mean**2) / (np.sum((of_point - mean[:, None]) ** 2) / free)
    said = f"(F = {ratio:.1f}, p = {scipy.stats.f.sf(ratio, 1, free):.2g})"
    assert any(said in doubt for doubt in fit.doubts), (said, fit.doubts)


def test_levels_that_leave_no_scatter_tell_no_noise():
    """One position has all seeds: the others say nothing of levels, and it is used up."""
    points = levelled(np.random.default_rng(0), [(p, s) for p in range(1, POINTS) for s in range(1, SEEDS)])
    assert points.freedom == 0 and np.isnan(points.noise()).all()
    assert np.allclose(points.draw(5, np.random.default_rng(0)), points.value)
