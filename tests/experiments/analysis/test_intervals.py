"""Intervals hold the truth as often as they say, and only because they count episodes."""

import math

import numpy as np
import pytest

from experiments.analysis.intervals import OVERALL, Interval, critical, interval_of, nats_first, overall
from hma_jax.evaluation.statistics import Stat, mean_and_sem
from hma_jax.evaluation.summary import summarise
from tests.experiments.analysis.worlds import intervals, judged


def held(interval, truth: float = 0.0) -> bool:
    return interval.low < truth < interval.high


def test_few_episodes_need_t_and_windows_are_no_episodes():
    """Of 400 samples of six episodes, 95 in 100 intervals should hold the truth."""
    hits = {"t": 0, "normal": 0, "windows": 0}
    for seed in range(400):
        table = judged(np.random.default_rng(seed), episodes=6)
        loss = table.metrics["cross_entropy"]
        stat, naive = mean_and_sem(loss, table.episode), mean_and_sem(loss)
        hits["t"] += held(interval_of(stat))
        hits["normal"] += abs(stat.mean) < 1.96 * stat.sem
        hits["windows"] += held(interval_of(naive))
    assert 0.93 * 400 <= hits["t"] <= 0.97 * 400
    assert hits["normal"] < 0.92 * 400 and hits["windows"] < 0.75 * 400


@pytest.mark.parametrize("truth", [0.04, 0.2, 0.8, 0.9, 0.96])
def test_the_interval_of_a_share_holds_its_truth_where_windows_agree(truth):
    """Eight windows of eight episodes. Where all succeeded or all failed, Student's t had an interval of no width, and
    of those that should hold a share of 0.96 in 95 of 100 cases it held 28."""
    hits, rng = [], np.random.default_rng(0)
    for _ in range(500):
        interval = interval_of(mean_and_sem(rng.random(8) < truth, np.arange(8))).of_share()
        assert 0 <= interval.low < interval.high <= 1
        hits.append(held(interval, truth))
    assert np.mean(hits) >= 0.93


def test_only_a_share_that_windows_agree_on_is_taken_for_luck():
    """A model that ignores actions finds the true ones one time in sixteen, in every window."""
    for share, low, high in ((1 / 16, 1 / 16, 1 / 16), (1.0, 0.025 ** (1 / 8), 1.0), (0.0, 0.0, 1 - 0.025 ** (1 / 8))):
        interval = interval_of(mean_and_sem(np.full(16, share), np.arange(16) // 2)).of_share()
        assert (interval.low, interval.high) == pytest.approx((low, high))
    unknown = interval_of(mean_and_sem([1.0, 1.0], [5, 5])).of_share()
    assert math.isnan(unknown.low) and math.isnan(unknown.high)


@pytest.mark.parametrize(("spread", "share", "holds"), [(0.0, 0.24, 0.93), (1.0, 0.39, 0.89)])
def test_an_episode_of_most_windows_makes_intervals_narrow(spread, share, holds):
    """As docs/statistics.md says: 24 windows are drawn among eight episodes, whose lengths differ by `spread` in the
    logarithm; `share` is that of the episode with most, on average."""
    rng, hits, shares = np.random.default_rng(0), [], []
    for _ in range(2000):
        length = np.exp(spread * rng.standard_normal(8))
        episode = rng.choice(8, size=24, p=length / length.sum())
        loss = rng.standard_normal(8)[episode] + 0.5 * rng.standard_normal(24)
        hits.append(held(interval_of(mean_and_sem(loss, episode))))
        shares.append(np.bincount(episode).max() / 24)
    assert np.mean(shares) == pytest.approx(share, abs=0.01) and np.mean(hits) == pytest.approx(holds, abs=0.015)


@pytest.mark.parametrize(("of_other", "alike", "held_out", "others", "holds"), [
    (0.35, 0.7, 24, 3, 0.94), (0.35, 0.7, 24, 15, 0.93), (0.35, 0.7, 8, 7, 0.91), (1.0, 1.0, 24, 15, 0.86),
    (1.0, 1.0, 8, 7, 0.67),
])  # fmt: skip
def test_other_sequences_of_the_same_episodes_make_intervals_narrow(of_other, alike, held_out, others, holds):
    """As docs/statistics.md says of action-nats: eight windows are judged under `others` of the episodes that are held
    out. What an episode does as a window has a standard deviation of 1, what it does as another `of_other`; the two
    correlate by `alike`. First as measured, then as of a distance between two episodes."""
    rng, draws, windows = np.random.default_rng(0), 5000, 8
    own, apart = rng.standard_normal((2, draws, held_out))
    other = of_other * (alike * own + np.sqrt(1 - alike**2) * apart)
    order = rng.random((draws, windows, held_out))
    order[:, np.arange(windows), np.arange(windows)] = np.inf  # none is its own other
    chosen = np.argsort(order)[..., :others].reshape(draws, -1)
    of_pair = 1.6 * (alike < 1) * rng.standard_normal((draws, windows, others))
    under = np.take_along_axis(other, chosen, 1).reshape(of_pair.shape) + of_pair
    values = own[:, :windows] + under.mean(2)
    half = critical(windows - 1) * values.std(1, ddof=1) / np.sqrt(windows)  # of `interval_of`
    assert np.mean(np.abs(values.mean(1)) < half) == pytest.approx(holds, abs=0.01)


def test_the_mean_over_robots_holds_its_truth():
    """Three robots of four episodes, of which one scatters most: few degrees of freedom, and a wide interval."""
    hits = normal = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        tables = [judged(rng, episodes=4, of_episode=scale) for scale in (0.1, 0.1, 2.0)]
        stats = [mean_and_sem(t.metrics["cross_entropy"], t.episode) for t in tables]
        interval = overall(stats)
        hits += held(interval)
        normal += abs(interval.mean) < 1.96 * interval.sem
    assert 0.92 * 400 <= hits <= 0.98 * 400 and normal < 0.90 * 400


def test_the_degrees_of_freedom_over_robots_are_satterthwaite_s():
    """Variances 1 and 4 with 3 and 5 degrees of freedom have 5^2 / (1^2 / 3 + 4^2 / 5)."""
    interval = overall([Stat(1.0, 1.0, 8, 4), Stat(2.0, 2.0, 12, 6)])
    half = critical(25 / (1 / 3 + 16 / 5)) * math.sqrt(5) / 2
    assert (interval.low, interval.high) == (pytest.approx(1.5 - half), pytest.approx(1.5 + half))


def test_episode_ids_carry_the_error():
    """Shuffled over the windows of a robot, each episode looks like all of it, and the error is a fraction."""
    table = judged(np.random.default_rng(0), episodes=20, each=8, of_window=0.1)
    ids = np.random.default_rng(1).permutation(table.episode)
    loss = table.metrics["cross_entropy"]
    truth, tampered = mean_and_sem(loss, table.episode), mean_and_sem(loss, ids)
    assert truth.sem == pytest.approx(np.std(loss.reshape(20, 8).mean(1), ddof=1) / math.sqrt(20), rel=1e-9)
    assert tampered.sem < 0.6 * truth.sem


def test_one_window_per_episode_is_the_textbook_interval():
    table = judged(np.random.default_rng(2), episodes=9, each=1)
    loss = table.metrics["cross_entropy"]
    interval = interval_of(mean_and_sem(loss, table.episode))
    half = 2.306004 * np.std(loss, ddof=1) / 3
    assert (interval.low, interval.high) == pytest.approx((loss.mean() - half, loss.mean() + half), rel=1e-6)
    assert (interval.n, interval.episodes) == (9, 9)


def test_one_episode_has_no_interval_and_takes_none_from_the_others():
    table = judged(np.random.default_rng(3), episodes=1, each=5)
    alone = interval_of(mean_and_sem(table.metrics["cross_entropy"], table.episode))
    assert math.isnan(alone.sem) and math.isnan(alone.low) and math.isnan(alone.errors)
    assert Interval(-0.1, 0.0, -0.1, -0.1).errors == -math.inf  # every episode says so
    among = overall([Stat(1.0, math.nan, 5, 1), Stat(3.0, 0.5, 40, 4)])
    assert among.mean == 2.0 and among.high > 2.0


def test_quantiles_are_those_of_the_tables():
    assert critical(2) == pytest.approx(4.302653, rel=1e-6)
    assert critical(math.inf) == pytest.approx(1.959964, rel=1e-6)
    assert math.isnan(critical(0))


def test_perplexity_is_the_transformed_interval_of_nats():
    table = judged(np.random.default_rng(4), robots=2, mean=2.0)
    found = intervals(summarise(table, 4))
    assert list(found) == [OVERALL, "r0", "r1"]
    nats = found["r0"]["cross_entropy"]
    perplexity = nats.exp()
    assert perplexity.mean == pytest.approx(found["r0"]["perplexity_corpus"].mean)
    assert (perplexity.low, perplexity.high) == (math.exp(nats.low), math.exp(nats.high))
    assert perplexity.sem == pytest.approx(found["r0"]["perplexity_corpus"].sem)
    assert interval_of(Stat(800.0, 1.0, 4, 4)).exp().mean == math.inf


def test_nats_come_first():
    assert nats_first(["psnr", "action_nats", "cross_entropy"]) == ["cross_entropy", "action_nats", "psnr"]
