from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.sampling.order import endless_shuffle, hash64, random_below, stream_seed
from data_pipelines.sampling.splits import held_out, smallest_hashes


@pytest.mark.parametrize("n", [1, 2, 10, 1000, 65535, 65536])
def test_every_epoch_is_a_permutation(n):
    for epoch in (0, 3):
        assert sorted(endless_shuffle(epoch * n + i, n, seed=7) for i in range(n)) == list(range(n))


def test_large_epochs_do_not_repeat_either():
    n = 10**9
    drawn = [endless_shuffle(n + i, n, seed=7) for i in range(3000)]
    assert len(set(drawn)) == 3000 and 0 <= min(drawn) < n // 100 and n - n // 100 < max(drawn) < n


@pytest.mark.parametrize("n", [50, 70000])
def test_epochs_and_seeds_give_different_orders(n):
    first = [endless_shuffle(i, n, 1) for i in range(50)]
    assert first != [endless_shuffle(n + i, n, 1) for i in range(50)]
    assert first != [endless_shuffle(i, n, 2) for i in range(50)]
    assert first == [endless_shuffle(i, n, 1) for i in range(50)]


def test_order_does_not_change_between_releases():
    """Changing these numbers changes the data of every run: resumed runs would not continue."""
    assert stream_seed(0, "order", "arm") == 2219857017995254801
    assert hash64(np.arange(2), 5).tolist() == [13168350753275463132, 7134611160154358618]
    assert [endless_shuffle(i, 10, 0) for i in range(10)] == [0, 3, 5, 7, 9, 6, 2, 8, 1, 4]
    assert [endless_shuffle(i, 100_000, 0) for i in range(3)] == [97360, 2206, 27692]


def test_random_below_is_even():
    counts = np.bincount([random_below(10, i, seed=3) for i in range(5000)], minlength=10)
    assert counts.min() > 420 and counts.max() < 580


def test_held_out_depends_on_the_dataset_not_on_order():
    a, b = held_out("arm", 100), held_out("base", 100)
    assert a.sum() == b.sum() == 5
    assert (a != b).any()
    assert not a[:5].all()


@pytest.mark.parametrize(
    "episodes, expected", [(1, 0), (2, 1), (3, 1), (4, 2), (25, 2), (100, 5), (10_000, 200)]
)
def test_held_out_number_is_bounded_and_leaves_half_for_training(episodes, expected):
    assert held_out("arm", episodes).sum() == expected


def test_subsets_are_nested():
    everything = np.arange(0, 2000, 3)
    previous: set[int] = set()
    for count in (1, 10, 100, 500):
        chosen = set(smallest_hashes("arm", everything, count, "subset/0").tolist())
        assert len(chosen) == count and previous <= chosen
        previous = chosen
    assert smallest_hashes("arm", everything, None, "x").tolist() == list(range(len(everything)))


def test_subset_follows_the_episode_not_its_position():
    """Leaving episodes out of the store moves positions; the chosen ones stay chosen."""
    few = np.arange(0, 50)
    chosen = set(few[smallest_hashes("arm", few, 10, "s")])
    without = np.array([e for e in few if e in chosen or e % 2])
    assert set(without[smallest_hashes("arm", without, 10, "s")]) == chosen
