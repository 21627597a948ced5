"""Two models on the same windows, and the same windows only."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.compare import Difference, Side, compare
from experiments.analysis.intervals import OVERALL
from experiments.analysis.paired import NotComparable
from hma_jax.evaluation.summary import summarise
from tests.experiments.analysis.worlds import judged, with_loss


def paired(a, b) -> dict[str, Difference]:
    """{scope: a less b} in nats per token."""
    sides = (Side(name, {0: table}, "") for name, table in (("a", a), ("b", b)))
    return {row.scope: row for row in compare(*sides) if row.metric == "cross_entropy"}


def better(table, seed: int, by: float = 0.1):
    loss = table.metrics["cross_entropy"]
    return with_loss(table, loss - by + 0.1 * np.random.default_rng(seed).normal(size=len(loss)))


def test_a_small_difference_is_seen_where_both_find_the_same_windows_hard():
    """0.1 nats, where episodes scatter by 1: the truth is held 95 times in 100, and zero is not."""
    hits = zero = 0
    for seed in range(300):
        table = judged(np.random.default_rng(seed), episodes=8)
        found = paired(better(table, seed + 1000), table)["r0"]
        hits += found.low < -0.1 < found.high
        zero += found.low < 0 < found.high
    assert 0.92 * 300 <= hits <= 0.98 * 300 and zero < 0.15 * 300


def test_broken_pairing_loses_the_error():
    """Windows of one model paired with others of the same robot: the difference is there, buried in scatter."""
    table = judged(np.random.default_rng(0), robots=2)
    other = better(table, 1)
    order = np.concatenate([np.random.default_rng(2).permutation(48), 48 + np.random.default_rng(3).permutation(48)])
    mixed = with_loss(other, other.metrics["cross_entropy"][order])
    honest, broken = (paired(x, table)[OVERALL] for x in (other, mixed))
    assert honest.mean == pytest.approx(broken.mean) and honest.sem < 0.2 * broken.sem
    assert honest.errors < -3 and abs(broken.errors) < 3


def test_the_difference_is_clustered_by_episode():
    """What a model gains it gains on whole episodes: as independent windows it would look too certain."""
    rng = np.random.default_rng(5)
    table = judged(rng, episodes=10, each=6)
    gain = np.repeat(rng.normal(size=10), 6)
    found = paired(with_loss(table, table.metrics["cross_entropy"] + gain), table)["r0"]
    assert found.sem == pytest.approx(np.std(gain.reshape(10, 6)[:, 0], ddof=1) / np.sqrt(10))


def test_order_of_windows_and_robots_does_not_matter():
    table = judged(np.random.default_rng(0), robots=3)
    other = better(table, 1)
    shuffled = other.rows(np.random.default_rng(2).permutation(len(other)))
    straight, mixed = paired(other, table), paired(shuffled, table)
    assert mixed["r2"].mean == pytest.approx(straight["r2"].mean)
    assert mixed[OVERALL].sem == pytest.approx(straight[OVERALL].sem)


def test_robots_that_one_model_alone_was_judged_on_are_left_out():
    table = judged(np.random.default_rng(0), robots=3)
    part = table.rows(np.flatnonzero(table.dataset != "r1"))
    assert list(paired(part, table)) == [OVERALL, "r0", "r2"]
    with pytest.raises(NotComparable, match="no robot was evaluated in both: r1 and r0, r2$"):
        paired(table.of("r1"), part)


def changed(table, column: str, row: int, value):
    """The table with one entry of a column (or metric) in another form."""
    if column in table.metrics:
        new = table.metrics[column].copy()
        new[row] = value
        return replace(table, metrics={**table.metrics, column: new})
    new = getattr(table, column).copy()
    new[row] = value
    return replace(table, **{column: new})


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("episode", 999, r"r1: only one of the two evaluations has window \('r1', 103, 0\) \(and 1 others\)"),
        ("start", 7, r"only one of the two evaluations has window \('r1', 103, 0\)"),
        ("frames", 5, r"window \(r1, episode 103, frame 0\) differs between the two: 5 and 12 real frames"),
        (
            "psnr_copy",
            3.0,
            r"window \(r1, episode 103, frame 0\) differs between the two: 3 and .* dB of psnr_copy",
        ),
        ("psnr_copy", np.nan, "differs between the two: nan and"),
    ],
)
def test_other_windows_are_refused_by_the_name_of_the_first(column, value, why):
    table = judged(np.random.default_rng(0), robots=2)
    row = 48 + 4  # of the second robot, its second episode
    with pytest.raises(NotComparable, match=why):
        paired(changed(table, column, row, value), table)


def test_the_overall_difference_is_that_of_the_means():
    a, b = (judged(np.random.default_rng(s), robots=3, mean=s) for s in (0, 1))
    b = replace(b, metrics={**b.metrics, "psnr_copy": a.metrics["psnr_copy"]})
    means = [summarise(x, 4).overall["cross_entropy"].mean for x in (a, b)]
    assert paired(a, b)[OVERALL].mean == pytest.approx(means[0] - means[1])
