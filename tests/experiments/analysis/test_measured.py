"""Losses of seeds that are judged on other robots each: what taking their levels out leaves of how they scatter."""

from collections.abc import Sequence

import numpy as np
import pytest
import scipy.stats

from experiments.analysis.fits import fit_power
from experiments.analysis.measured import Measurements, NoLevel, Position, measure
from hma_jax.evaluation.windows import WindowTable
from tests.experiments.analysis.curves import of_one_run, power, sizes

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


def windows_of(loss: Sequence[float], robots: str, episode: Sequence[int]) -> WindowTable:
    """Of robots that are the letters of `robots`."""
    zero = np.zeros(len(loss), int)
    return WindowTable(np.array(list(robots)), np.array(episode), zero, zero + 4, {"cross_entropy": np.array(loss)})


def test_a_loss_is_the_mean_over_windows_then_over_robots():
    table = windows_of([1.0, 2.0, 6.0, 4.0, 6.0], "aaabb", [0, 1, 2, 0, 1])
    positions = [Position(str(seed), "run", seed, (1e4,), ("a", "b")) for seed in range(2)]
    points = measure(("trunk parameters",), positions, {"0": table, "1": table})
    assert points.value.tolist() == [4, 4] and points.levels == 0
    assert points.draw(20, np.random.default_rng(0), episodes=False).tolist() == [[4, 4]] * 20


def test_where_every_position_scatters_alike_its_noise_is_the_deviation_of_a_sample():
    points = of_one_run([1, 1, 2, 2], [0, 1, 0, 1], np.exp([-0.1, 0.1, 0.4, 0.6]))
    np.testing.assert_allclose(points.noise(), np.std([-0.1, 0.1], ddof=1))


def test_branches_of_a_run_draw_the_same_seeds_in_whatever_order_they_come():
    drawn = of_one_run([1, 1, 2, 2], [0, 1, 1, 0], [3.0, 5.0, 5.0, 3.0]).draw(50, np.random.default_rng(0))
    np.testing.assert_allclose(drawn[:, :2].mean(1), drawn[:, 2:].mean(1))
    assert drawn[:, :2].mean(1).std() > 0.5


def test_seeds_of_robots_of_their_own_have_one_level_their_geometric_mean():
    """Robot b is four times as hard as a, on average over the two positions at which both are judged."""
    losses = {"a1": 2.0, "a2": 1.0, "a3": 0.5, "b1": 9.0, "b2": 32 / 9}
    positions = [Position(name, name[1], "ab".index(name[0]), (float(name[1]),), (name[0],)) for name in losses]
    tables = {name: windows_of([loss], name[0], [0]) for name, loss in losses.items()}
    points = measure(("trunk parameters",), positions, tables)
    np.testing.assert_allclose(points.value, [4, 2, 1, 9 / 2, 16 / 9])
    assert points.levels == 1
    with pytest.raises(NoLevel, match="no position has a finished trial"):
        measure(("trunk parameters",), [positions[0], positions[4]], tables)


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
