from __future__ import annotations

import itertools
import math
import timeit
from collections import Counter
from time import process_time

import numpy as np
import pytest

from data_pipelines.sampling.order import endless_shuffle, hash64, permute, random_below, stream_seed
from data_pipelines.sampling.splits import HeldOut, held_out, smallest_hashes, subset


@pytest.mark.parametrize("n", [*range(1, 40), 63, 64, 65, 1000, 60_000, 65_535, 65_536, 65_537, 10**6])
def test_every_epoch_is_a_permutation(n):
    for epoch in (0, 3):
        drawn = endless_shuffle(epoch * n + np.arange(n), n, seed=7)
        assert np.array_equal(np.sort(drawn), np.arange(n))


def test_large_epochs_do_not_repeat_either():
    n = 10**9
    drawn = endless_shuffle(n + np.arange(100_000), n, seed=7)
    assert len(set(drawn.tolist())) == 100_000 and 0 <= drawn.min() < n // 1000
    assert n - n // 1000 < drawn.max() < n


@pytest.mark.parametrize("n", [50, 70000])
def test_epochs_and_seeds_give_different_orders(n):
    first = endless_shuffle(np.arange(50), n, 1).tolist()
    assert first != endless_shuffle(n + np.arange(50), n, 1).tolist()
    assert first != endless_shuffle(np.arange(50), n, 2).tolist()
    assert first == [endless_shuffle(i, n, 1) for i in range(50)]


def test_sizes_and_seeds_may_differ_within_a_call():
    sizes, seeds = np.array([1, 7, 60_000, 10**9]), np.array([3, 1, 4, 1])
    whole = endless_shuffle(12345, sizes, seeds)
    assert whole.tolist() == [endless_shuffle(12345, n, s) for n, s in zip(sizes, seeds, strict=True)]
    assert (whole < sizes).all()


@pytest.mark.parametrize("n, least", [(3, 900), (4, 200), (5, 30)])
def test_no_permutation_is_preferred(n, least):
    """With 6,000 keys every order of a few things comes up about as often as any other."""
    drawn = permute(np.arange(n), n, hash64(np.arange(6000), 5)[:, None])
    counts = Counter(map(tuple, drawn.tolist()))
    assert len(counts) == math.factorial(n) and min(counts.values()) > least


def test_a_draw_costs_the_same_whatever_the_number_and_size_of_datasets():
    """A cache of 128 permutations cost 1 microsecond a draw with 100 datasets of 60,000 windows, 5,800 with 130."""

    def seconds(datasets: int, windows: int) -> float:
        seeds, position = np.arange(datasets), itertools.count()
        draws = [lambda: endless_shuffle(next(position) // 2 + seeds, windows, seeds) for _ in range(5)]
        return min(timeit.timeit(draw, timer=process_time, number=4) for draw in draws) / datasets

    few, many = seconds(100, 60_000), seconds(130, 60_000)
    assert many < 3 * few and seconds(130, 10**9) < 3 * few
    assert many < 4 * 500e-6


def test_order_does_not_change_between_releases():
    """Changing these numbers changes the data of every run, so `ORDER_VERSION` changes with them."""
    assert stream_seed(0, "order", "arm") == 2219857017995254801
    assert hash64(np.arange(2), 5).tolist() == [13168350753275463132, 7134611160154358618]
    assert endless_shuffle(np.arange(10), 10, 0).tolist() == [0, 2, 4, 6, 1, 7, 9, 3, 8, 5]
    assert endless_shuffle(np.arange(3), 100_000, 0).tolist() == [36333, 38480, 56565]
    assert np.flatnonzero(held_out("arm", np.arange(100), HeldOut())).tolist() == [16, 52, 60, 64, 81]
    assert smallest_hashes("arm", np.arange(100), 3, "subset/0").tolist() == [11, 29, 68]


def test_random_below_is_even_and_other_for_every_seed():
    ours, others = ([random_below(10, i, seed) for i in range(5000)] for seed in (3, 4))
    counts = np.bincount(ours, minlength=10)
    assert counts.min() > 420 and counts.max() < 580
    assert 420 < np.equal(ours, others).sum() < 580


def test_held_out_depends_on_the_dataset_not_on_order():
    a, b = held_out("arm", np.arange(100), HeldOut()), held_out("base", np.arange(100), HeldOut())
    assert a.sum() == b.sum() == 5
    assert (a != b).any()
    assert not a[:5].all()


@pytest.mark.parametrize(
    "episodes, expected", [(1, 0), (2, 1), (3, 1), (4, 1), (8, 2), (25, 2), (55, 3), (100, 5), (10_000, 200)]
)
def test_held_out_number_is_bounded_and_leaves_three_in_four_for_training(episodes, expected):
    assert held_out("arm", np.arange(episodes), HeldOut()).sum() == expected


@pytest.mark.parametrize("episodes, expected", [(9, 2), (32, 8), (33, 8), (400, 20)])
def test_the_least_number_held_out_is_a_fraction_of_a_small_dataset(episodes, expected):
    """Of nine episodes four were, where at least eight were asked for: five were left to train on."""
    assert held_out("arm", np.arange(episodes), HeldOut(min_val=8)).sum() == expected
    assert held_out("arm", np.arange(9), HeldOut(min_val=8, max_val_fraction=0.5)).sum() == 4


def test_subsets_are_nested():
    everything = np.arange(0, 2000, 3)
    previous: set[int] = set()
    for count in (1, 10, 100, 500):
        positions = smallest_hashes("arm", everything, count, "subset/0").tolist()
        chosen = set(positions)
        assert len(chosen) == count and previous <= chosen and positions == sorted(positions)
        previous = chosen
    assert smallest_hashes("arm", everything, None, "x").tolist() == list(range(len(everything)))


def test_a_subset_follows_names_whatever_else_could_have_been_drawn():
    ids, present = hash64(np.arange(60), 1), np.arange(60)
    drawn = subset("arm", ids, present >= 0, present, 10, "s").tolist()
    assert len(drawn) == 10
    fewer = (present % 3 == 0) | np.isin(present, drawn)
    assert subset("arm", ids, fewer, present, 10, "s").tolist() == drawn
    left = present[present != drawn[4]]
    assert left[subset("arm", ids, fewer, left, 10, "s")].tolist() == [e for e in drawn if e != drawn[4]]


def test_subset_follows_the_episode_not_its_position():
    """Leaving episodes out of the store moves positions; the chosen ones stay chosen."""
    few = np.arange(0, 50)
    chosen = set(few[smallest_hashes("arm", few, 10, "s")])
    without = np.array([e for e in few if e in chosen or e % 2])
    assert set(without[smallest_hashes("arm", without, 10, "s")]) == chosen
