"""Which dataset a position is drawn from: a draw, not a cycle, and its numbers of draws are exact."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.sampling.draws import BLOCK, Draws
from data_pipelines.sampling.mixture import mixture_weights

WEIGHTS = {
    "equal": np.full(40, 1 / 40),
    "one": np.ones(1),
    "none": np.array([0.0, 0.75, 0.25, 0.0, 0.0]),
    "tiny": np.array([1e-7, 0.6, 1e-9, 0.4 - 1.01e-7]),
    "decades": mixture_weights(10.0 ** np.arange(1, 7), tau=3.0),
    "many": mixture_weights(np.arange(1, 1001), tau=3.0),
}


def test_equal_weights_give_other_datasets_in_every_batch_and_for_every_seed():
    """Forty datasets, batches of 12: grain's mixture gave ten sequences for ever, the same for every seed."""
    sequences = {
        seed: [tuple(row) for row in Draws(WEIGHTS["equal"], seed).at(np.arange(12_000))[0].reshape(-1, 12)]
        for seed in (0, 1)
    }
    for batches in sequences.values():
        assert len(set(batches)) == 1000
        repeats = [len(set(batch)) for batch in batches]
        assert min(repeats) < 9 and max(repeats) > 10, "a batch may hold a dataset twice, as in free draws"
    assert not set(sequences[0]) & set(sequences[1])


@pytest.mark.parametrize("name", WEIGHTS)
def test_the_draws_of_a_dataset_are_numbered_without_gaps(name):
    """Hence its own order visits every window once per epoch."""
    datasets, numbers = Draws(WEIGHTS[name], 3).at(np.arange(6 * BLOCK))
    for d in range(len(WEIGHTS[name])):
        own = numbers[datasets == d]
        assert np.array_equal(own, np.arange(len(own)))


@pytest.mark.parametrize("name", WEIGHTS)
def test_counts_follow_the_weights_at_any_time(name):
    weights = WEIGHTS[name]
    draws = Draws(weights, 5)
    previous = np.zeros(len(weights), np.int64)
    assert (draws.counts(0) == 0).all()
    for block in (1, 2, 3, 50, 51, 10_000, 10**6, 2**31):
        counts = draws.counts(block)
        assert counts.sum() == block * BLOCK and (counts >= previous).all()
        assert np.abs(counts - weights * block * BLOCK).max() < 10 + block * BLOCK * 1e-12
        previous = counts


def test_any_position_can_be_asked_for_alone():
    draws, positions = Draws(WEIGHTS["decades"], 1), np.array([0, BLOCK - 1, BLOCK, 5 * BLOCK + 7, 2**39])
    datasets, numbers = draws.at(positions)
    for at, d, n in zip(positions, datasets, numbers, strict=True):
        assert [x.tolist() for x in draws.at(np.array([at]))] == [[d], [n]]
    assert np.array_equal(draws.at(positions[::-1])[0], datasets[::-1])


def test_a_dataset_of_small_weight_is_drawn_early_or_late_by_chance():
    """Its first draw comes at another position for every seed."""
    first = [int(np.argmax(Draws((0.999, 0.001), seed).at(np.arange(20 * BLOCK))[0])) for seed in range(20)]
    assert len(set(first)) == 20 and len({at // BLOCK for at in first}) > 1
