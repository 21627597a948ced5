"""Means and their errors: by formula, and by drawing samples of which the truth is known."""

import math

import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.evaluation.statistics import (
    Estimate,
    Stat,
    clusters_of,
    estimate_corpus_perplexity,
    estimate_mean,
    estimate_perplexity,
    mean_and_sem,
    stat_of,
    stratified,
)


def episodes_of_windows(seed: int, episodes: int = 30, correlated: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(values, episode numbers): 1 to 7 windows per episode, which share a part of their value; mean 0."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 8, episodes)
    episode = np.repeat(rng.permutation(1000)[:episodes], sizes)
    shared = np.repeat(rng.normal(size=episodes), sizes)
    return correlated * shared + rng.normal(size=len(shared)), episode


def test_standard_error_shrinks_with_the_root_of_n():
    values = np.random.default_rng(1).normal(3.0, 2.0, 10_000)
    stat = mean_and_sem(values)
    assert (stat.n, stat.episodes) == (10_000, 0) and stat.sem == pytest.approx(2.0 / 100, rel=0.05)
    assert stat.mean == pytest.approx(3.0, abs=4 * stat.sem)


def test_one_window_per_episode_is_the_plain_formula():
    values = np.random.default_rng(2).normal(size=17)
    stat = mean_and_sem(values, np.arange(17)[::-1])
    assert stat.sem == pytest.approx(np.std(values, ddof=1) / math.sqrt(17), rel=1e-12)
    assert (stat.mean, stat.n, stat.episodes) == (pytest.approx(values.mean()), 17, 17)
    assert mean_and_sem(values).sem == pytest.approx(stat.sem)


def test_the_error_is_the_sum_over_pairs_of_windows_of_one_episode():
    values, episode = episodes_of_windows(3, episodes=5)
    n, groups = len(values), 5
    total = 0.0
    for i in range(n):
        for j in range(n):
            if episode[i] == episode[j]:
                total += (values[i] - values.mean()) * (values[j] - values.mean())
    assert mean_and_sem(values, episode).sem == pytest.approx(math.sqrt(total * groups / (groups - 1)) / n)


def test_intervals_hold_the_truth_as_often_as_they_say_only_if_episodes_are_counted():
    """The mean is 0 by construction; 1.96 errors should hold it 95 times in 100 (30 episodes: about 93)."""
    hits = {"episodes": 0, "windows": 0}
    for seed in range(600):
        values, episode = episodes_of_windows(seed)
        for name, stat in (("episodes", mean_and_sem(values, episode)), ("windows", mean_and_sem(values))):
            hits[name] += abs(stat.mean) < 1.96 * stat.sem
    assert 0.90 <= hits["episodes"] / 600 <= 0.97
    assert hits["windows"] / 600 < 0.80


def test_the_error_of_a_difference_is_known_though_both_models_find_the_same_windows_hard():
    """Two models 0.1 apart on the same windows: the truth is held, by an interval a fraction as wide."""
    held = narrow = 0
    for seed in range(300):
        values, episode = episodes_of_windows(seed)
        better = values + 0.1 + 0.1 * np.random.default_rng(seed + 1000).normal(size=len(values))
        difference = stat_of(estimate_mean(better).minus(estimate_mean(values)), clusters_of(episode))
        held += abs(difference.mean - 0.1) < 1.96 * difference.sem
        narrow += difference.sem < 0.2 * mean_and_sem(values, episode).sem
    assert held >= 0.9 * 300 and narrow == 300


def test_one_value_or_one_episode_has_an_unknown_error_not_zero():
    assert math.isnan(mean_and_sem([2.0]).sem)
    one = mean_and_sem([2.0, 3.0, 5.0], [7, 7, 7])
    assert math.isnan(one.sem) and (one.n, one.episodes) == (3, 1)


def test_stratified_mean_weighs_datasets_equally_or_as_told_and_combines_errors():
    stats = [Stat(1.0, 0.3, 10, 5), Stat(3.0, 0.4, 1000, 50)]
    assert stratified(stats) == Stat(2.0, pytest.approx(0.25), 1010, 55)
    weighed = Stat(pytest.approx(2.5), pytest.approx(math.hypot(0.25 * 0.3, 0.75 * 0.4)), 1010, 55)
    assert stratified(stats, [1, 3]) == weighed


def test_a_dataset_of_one_episode_takes_the_scatter_of_the_others():
    stats = [Stat(1.0, 0.5, 40, 4), Stat(3.0, math.nan, 8, 1)]
    assert stratified(stats).sem == pytest.approx(math.sqrt(0.5**2 + 1.0**2) / 2)
    assert math.isnan(stratified(stats[1:]).sem)
    assert math.isnan(stratified([Stat(0.0, 0.0, 2, 2), Stat(0.04, math.nan, 2, 1)]).sem)  # no scatter tells nothing
    assert stratified([Stat(0.0, 0.0, 2, 2), Stat(0.0, 0.0, 4, 2)]).sem == 0


def test_perplexity_has_an_error_even_when_all_windows_form_one_group():
    losses, episode = [1.0, 1.2, 0.8], [0, 0, 1]
    one, many = (stat_of(estimate_perplexity(losses, group), clusters_of(episode)) for group in (4, 1))
    assert one.mean == pytest.approx(math.e) and (one.n, one.episodes) == (3, 2)
    assert one.sem == pytest.approx(math.e * mean_and_sem(losses, episode).sem)
    assert many.mean > one.mean


def test_corpus_perplexity_error_is_the_delta_method():
    """Against the scatter of the perplexity itself over samples."""
    drawn = [2 + 0.3 * episodes_of_windows(seed, 60)[0] for seed in range(300)]
    errors = [
        stat_of(estimate_corpus_perplexity(2 + 0.3 * values), clusters_of(episode)).sem
        for values, episode in (episodes_of_windows(seed, 60) for seed in range(300))
    ]
    assert np.mean(errors) == pytest.approx(np.std([np.exp(x.mean()) for x in drawn]), rel=0.15)


def test_a_model_that_is_certain_and_wrong_has_an_infinite_perplexity():
    estimate = estimate_corpus_perplexity(np.array([700.0, 800.0]))
    assert estimate.value == np.inf
    assert math.isnan(estimate.minus(estimate).value)


def test_numbers_that_do_not_belong_together_are_refused():
    with pytest.raises(ConfigError, match="no values"):
        mean_and_sem([])
    with pytest.raises(ConfigError, match="3 values but 2 episode numbers"):
        stat_of(Estimate(0.0, np.zeros(3)), clusters_of([1, 2]))
