"""Resampling over seeds and episodes: of the right things, by the right amount, quickly."""

import time
from collections.abc import Sequence

import numpy as np
import pytest

from experiments.analysis.bootstrap import Panel, bootstrap_intervals, make_panel, resample
from experiments.analysis.intervals import OVERALL, critical
from experiments.analysis.paired import NotComparable
from hma_jax.config import ConfigError
from hma_jax.evaluation.summary import summarise
from tests.experiments.analysis.worlds import intervals, judged, under_seeds, with_loss

LOSS = "cross_entropy"


def three_seeds(seed: int, of_seed: float, **world) -> Panel:
    rng = np.random.default_rng(seed)
    return make_panel([under_seeds(judged(rng, **world), rng, 3, of_seed)], LOSS)


def panel_of(robots: str, episode: Sequence[int], *points: Sequence[Sequence[float]]) -> Panel:
    """Of windows whose robots are the letters of `robots`; a point has a row for each of its seeds."""
    values = tuple(np.array(rows, float) for rows in points)
    return Panel(np.array(list(robots)), np.array(episode), values, tuple(tuple(range(len(v))) for v in values))


@pytest.mark.parametrize(("of_seed", "episodes"), [(1.0, 12), (0.02, 6)])
def test_intervals_hold_the_truth_whichever_level_scatters_most(of_seed, episodes):
    """Of 200 studies, 95 in 100; one of the episodes alone only if seeds agree, one of windows never."""
    both = alone = windows = 0
    for seed in range(200):
        panel = three_seeds(seed, of_seed, robots=2, episodes=episodes, each=3)
        (interval,) = bootstrap_intervals(panel, draws=150, seed=seed)
        both += interval.low < 0 < interval.high
        fixed = resample(panel, 150, seed, over_seeds=False)
        alone += abs(fixed.value[0]) < 1.96 * fixed.drawn.std()
        flat = panel.points[0].ravel()
        windows += abs(flat.mean()) < 1.96 * flat.std() / np.sqrt(len(flat))
    assert 0.92 * 200 <= both <= 0.985 * 200
    assert windows < 0.8 * 200 and (alone < 0.8 * 200) == (of_seed == 1.0)


def test_without_a_scatter_of_seeds_it_is_the_clustered_error():
    table = judged(np.random.default_rng(0), robots=4, episodes=10, each=3)
    (interval,) = bootstrap_intervals(make_panel([{0: table}], LOSS), draws=20_000)
    want = intervals(summarise(table, 1))[OVERALL][LOSS]
    assert interval.mean == pytest.approx(want.mean) and interval.sem == pytest.approx(want.sem, rel=0.03)
    assert (interval.n, interval.episodes) == (want.n, want.episodes) == (120, 40)


def test_a_robot_that_scatters_most_leaves_few_degrees_of_freedom():
    table = judged(np.random.default_rng(2), robots=4, episodes=6, each=2)
    wild = np.where(table.dataset == "r0", 30.0, 1.0) * table.metrics[LOSS]
    (interval,) = bootstrap_intervals(make_panel([{0: with_loss(table, wild)}], LOSS), draws=20_000)
    want = intervals(summarise(with_loss(table, wild), 1))[OVERALL][LOSS]
    t, expected = ((i.high - i.mean) / i.sem for i in (interval, want))
    assert t == pytest.approx(expected, rel=0.02) and t > 2.5  # five episodes' worth; twenty would be 2.09


def test_three_seeds_have_the_variance_of_their_mean_not_two_thirds_of_it():
    table = judged(np.random.default_rng(0), episodes=5)
    loss = table.metrics[LOSS]
    seeds = {s: with_loss(table, loss + shift) for s, shift in enumerate((0.0, 1.0, 5.0))}
    drawn = resample(make_panel([seeds], LOSS), 20_000, over_episodes=False).drawn
    assert drawn.var() == pytest.approx(np.var([0, 1, 5], ddof=1) / 3, rel=0.05)


def test_seeds_are_drawn_apart_from_episodes():
    """As many seeds as episodes: drawn alike, their deviations would add up, and not their variances."""
    apart = np.array([0.0, 1.0, 5.0])
    panel = panel_of("aaa", [0, 1, 2], apart[:, None] + apart)
    both, seeds = (resample(panel, 20_000, over_episodes=e).drawn.var() for e in (True, False))
    assert both == pytest.approx(2 * seeds, rel=0.05)


def test_a_robot_of_one_episode_is_taken_to_scatter_as_the_others():
    table = judged(np.random.default_rng(1), robots=3, episodes=6)
    kept = table.rows(np.flatnonzero((table.dataset != "r2") | (table.episode == 100)))
    (interval,) = bootstrap_intervals(make_panel([{0: kept}], LOSS), draws=20_000)
    want = intervals(summarise(kept, 1))[OVERALL][LOSS]
    assert interval.sem == pytest.approx(want.sem, rel=0.05)
    assert interval.sem > 1.2 * bootstrap_intervals(make_panel([{0: table}], LOSS))[0].sem
    (nothing,) = bootstrap_intervals(make_panel([{0: kept.of("r2")}], LOSS))
    assert np.isnan(nothing.sem) and np.isnan(nothing.low)


def test_robots_count_equally_however_many_windows_they_have():
    episode, loss = [0, 0, 1, 0, 1], [1, 1, 4, 5, 7]
    panel = panel_of("aaabb", episode, [loss])
    assert resample(panel, 5).value == pytest.approx([4]) and bootstrap_intervals(panel)[0].mean == pytest.approx(4)
    # An episode of two windows weighs twice in a draw, too: what is the same everywhere stays so.
    np.testing.assert_allclose(resample(panel_of("aaabb", episode, [[3] * 5]), 50).drawn, 3)


@pytest.mark.parametrize("value", [1.0, 0.1, 1 / 3, -7e5])
def test_values_that_are_all_equal_have_no_error(value):
    """Rounding gave them one of 1e-16, and a mean of 1 was 6e15 standard errors from zero."""
    (interval,) = bootstrap_intervals(panel_of("a" * 8, range(8), np.full((3, 8), value)))
    assert interval.sem == 0 and interval.low == interval.mean == interval.high == pytest.approx(value)
    (small,) = bootstrap_intervals(panel_of("a" * 8, range(8), value * (1 + 1e-9 * np.arange(8.0)[None])))
    assert small.sem > 0


def test_half_an_interval_is_the_t_of_each_level_times_its_error():
    seeds = panel_of("aabb", [0, 1, 0, 1], [[0] * 4, [1] * 4, [5] * 4])
    # Each seed finds the episodes of another robot hard; on average over seeds those of both are, three freedoms each.
    hard = [2, -2, 2, -2, 0, 0, 0, 0]
    each = panel_of("aaaabbbb", [0, 1, 2, 3] * 2, [hard, hard[::-1]])
    # Variances of 1 with one degree of freedom and with four: (1 + 1)^2 / (1 / 1 + 1 / 4) of both.
    unequal = panel_of("aabbbbb", [0, 1, 0, 1, 2, 3, 4], [[1, -1, *np.sqrt(5) * np.array([1, -1, 1, -1, 0])]])
    for panel, freedom, error in (
        (seeds, 2, np.std([0, 1, 5], ddof=1) / np.sqrt(3)),
        (each, 6, np.sqrt(1 / 6)),
        (unequal, 3.2, np.sqrt(1 / 2)),
    ):
        (interval,) = bootstrap_intervals(panel, 20_000)
        assert interval.high - interval.mean == pytest.approx(critical(freedom) * error, rel=0.03)


def test_points_of_the_same_seeds_draw_the_same_ones():
    rows = np.repeat([[0.0], [1.0], [5.0]], 4, axis=1)
    panel = panel_of("aabb", [0, 1, 0, 1], rows, rows + 10)
    drawn = resample(panel, 50, over_episodes=False).drawn
    np.testing.assert_allclose(drawn[:, 1] - drawn[:, 0], 10)
    assert [interval.mean for interval in bootstrap_intervals(panel)] == pytest.approx([2, 12])


def test_a_window_is_known_where_every_seed_has_it():
    assert panel_of("ab", [0, 0], [[1, np.nan], [1, 2]]).known.tolist() == [True, False]


def test_permuted_episode_ids_change_the_error():
    panel = three_seeds(3, 0.01, episodes=20, each=8, of_window=0.1)
    tampered = Panel(panel.robot, np.random.default_rng(0).permutation(panel.episode), panel.points, panel.seeds)
    honest, wrong = (bootstrap_intervals(p)[0].sem for p in (panel, tampered))
    assert wrong < 0.6 * honest


def test_points_of_a_curve_are_drawn_together():
    """Models of one curve find the same episodes hard: their difference is known far better than either."""
    rng = np.random.default_rng(0)
    table = judged(rng, robots=3)
    points = [under_seeds(with_loss(table, table.metrics[LOSS] + shift), rng, 3, 0.01, 0.01) for shift in (0.0, 0.2)]
    panel = make_panel(points, LOSS)
    drawn = resample(panel).drawn
    assert (drawn[:, 1] - drawn[:, 0]).std() < 0.1 * drawn[:, 0].std()
    (difference,) = bootstrap_intervals(make_panel(points[1:], LOSS).minus(make_panel(points[:1], LOSS)))
    assert 0 < difference.low < 0.2 < difference.high
    swapped = make_panel([dict(reversed(points[1].items()))], LOSS).minus(make_panel(points[:1], LOSS))
    assert swapped.seeds == ((2, 1, 0),)
    np.testing.assert_allclose(swapped.points[0][::-1], panel.points[1] - panel.points[0])


def test_the_same_seed_draws_the_same_and_a_thousand_draws_are_quick():
    rng = np.random.default_rng(0)
    table = judged(rng, robots=40, episodes=24, each=1)
    panel = make_panel([under_seeds(table, rng, 3, 0.1) for _ in range(5)], LOSS)
    began = time.process_time()
    first = resample(panel, 1000, seed=7).drawn
    assert time.process_time() - began < 3.0  # about 0.1 s
    np.testing.assert_array_equal(first, resample(panel, 1000, seed=7).drawn)
    assert not np.array_equal(first, resample(panel, 1000, seed=8).drawn)
    assert first.shape == (1000, 5)


def test_what_does_not_belong_together_is_refused():
    rng = np.random.default_rng(0)
    table = judged(rng, robots=2)
    other = judged(np.random.default_rng(1), robots=2)
    with pytest.raises(NotComparable, match=r"window \(r0, episode 100, frame 0\) differs between the two"):
        make_panel([{0: table, 1: other}], LOSS)
    with pytest.raises(NotComparable, match="not evaluated in every trial: r1"):
        make_panel([{0: table, 1: table.of("r0")}], LOSS)
    with pytest.raises(NotComparable, match="not evaluated: r9"):
        make_panel([{0: table}], LOSS, ["r9"])
    with pytest.raises(ConfigError, match="a trial has no ssim"):
        make_panel([{0: table}], "ssim")
    one, two = make_panel([{0: table}], LOSS), make_panel([{1: table}], LOSS)
    with pytest.raises(NotComparable, match=r"seeds \(0,\) and \(1,\) have none in common"):
        one.minus(two)
    with pytest.raises(NotComparable, match="different windows"):
        one.minus(make_panel([{0: table.of("r0")}], LOSS))
    with pytest.raises(NotComparable, match="different windows"):
        one.minus(Panel(one.robot, one.episode + 1, one.points, one.seeds))
    with pytest.raises(NotComparable, match="or points"):
        one.minus(make_panel([{0: table}] * 2, LOSS))
    with pytest.raises(ConfigError, match="seeds must be given, each once"):
        Panel(one.robot, one.episode, one.points, ((),))
    with pytest.raises(ConfigError, match="seeds must be given, each once"):
        Panel(one.robot, one.episode, (np.repeat(one.points[0], 2, axis=0),), ((0, 0),))
