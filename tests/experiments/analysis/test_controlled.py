"""Robots that a model follows, and how sure that is."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.controllability import controllability, count_following, expected_by_chance
from experiments.analysis.explained_share import read_shares
from tests.experiments.analysis.worlds import judged


def model(follows: float, seed: int = 0, shift: float = 0.0):
    """Two robots of the suite and one of nobody's; of the first, nobody simulates another truth."""
    rng = np.random.default_rng(seed)
    table = judged(rng, robots=3, episodes=8)
    n = len(table)
    names = {"r0": "two_link_arm", "r1": sorted(read_shares())[0], "r2": "mine"}
    scatter = np.repeat(np.random.default_rng(1).normal(size=n // 4), 4)
    metrics = {
        "psnr_copy": table.metrics["psnr_copy"],
        "delta_psnr": follows * (1 + 0.2 * scatter) + shift,
        "action_nats": follows * (0.3 + 0.1 * scatter),
        "retrieval": np.where(np.arange(n) % 16 == 0, 1.0, float(follows > 0)),
        "retrieval_chance": np.full(n, 1 / 16),
        "counterfactual_gain": np.where(table.dataset == "r0", np.nan, follows * (2 + scatter)),
    }
    dataset = np.asarray([names[r] for r in table.dataset.tolist()])
    return replace(table, dataset=dataset, metrics=metrics)


def test_robots_beyond_two_errors_are_counted_against_what_a_deaf_model_has():
    follows, deaf = controllability({0: model(1.0)}, rate=2.0), controllability({0: model(0.0)}, rate=2.0)
    for metric, robots in (("delta_psnr", 3), ("action_nats", 3), ("retrieval", 3), ("counterfactual_gain", 2)):
        assert count_following(follows, metric) == (robots, robots)
        assert count_following(deaf, metric) == (0, robots)
    assert all(row.errors == 0 for row in deaf if row.metric != "retrieval")
    assert {row.deaf for row in deaf if row.metric == "retrieval"} == {1 / 16}


def test_a_deaf_model_has_as_many_robots_beyond_as_is_said():
    found, said, rng = 0, 0.0, np.random.default_rng(3)
    for _ in range(100):
        table = judged(rng, robots=6, episodes=4)
        rows = controllability({0: replace(table, metrics={"delta_psnr": table.metrics["cross_entropy"]})}, rate=2.0)
        found, said = found + count_following(rows, "delta_psnr")[0], said + expected_by_chance(rows, "delta_psnr")
    assert said == pytest.approx(100 * 6 * 0.0697, rel=1e-3)
    assert found == pytest.approx(said, abs=3 * said**0.5)


def test_hits_of_a_few_windows_are_compared_with_no_number_of_robots():
    """They are not distributed as Student's t: chance was said to have 1.6 of 40 robots beyond two standard errors, and
    has 0.03."""
    rows = controllability({0: model(1.0)}, rate=2.0)
    assert expected_by_chance(rows, "retrieval") is None
    assert expected_by_chance(rows, "action_nats") > 0


def test_retrieval_that_never_failed_might_have():
    table = model(1.0)
    always = replace(table, metrics=table.metrics | {"retrieval": np.ones(len(table))})
    own = [r for r in controllability({0: always, 1: always}, rate=2.0) if r.metric == "retrieval"]
    assert len(own) == 3 and all((r.mean, r.sem, r.high, r.errors) == (1, 0, 1, np.inf) for r in own)
    assert all(r.low == pytest.approx(0.025 ** (1 / 8)) for r in own)
    assert count_following(own, "retrieval") == (3, 3)


def test_a_deaf_model_s_retrieval_is_that_of_the_windows_that_have_other_actions():
    table = model(1.0)
    alone = np.arange(len(table)) % 2 == 0
    metrics = {name: np.where(alone, np.nan, table.metrics[name]) for name in ("retrieval", "retrieval_chance")}
    rows = controllability({0: replace(table, metrics=table.metrics | metrics)}, rate=2.0)
    own = [row for row in rows if row.metric == "retrieval"]
    assert [(row.n, row.deaf) for row in own] == [(int(alone.sum()) // 3, 1 / 16)] * 3


def test_a_robot_without_actions_is_never_there_by_chance():
    """It has the value of a deaf model in every window; it was counted as one that might be far from it."""
    table = judged(np.random.default_rng(3), robots=6, episodes=4)
    values = np.where(table.dataset == "r0", 1e-7, table.metrics["cross_entropy"])  # up to rounding
    rows = controllability({0: replace(table, metrics={"delta_psnr": values})}, rate=2.0)
    assert count_following(rows, "delta_psnr")[1] == 6
    assert expected_by_chance(rows, "delta_psnr") == pytest.approx(5 * 0.0697, rel=1e-3)


def test_rounding_is_no_control():
    """Always the same 1e-6 dB: many standard errors, and nothing."""
    rows = controllability({0: model(0.0, shift=1e-6)}, rate=2.0)
    assert count_following(rows, "delta_psnr") == (0, 3)
    assert count_following(controllability({0: model(0.0, shift=1e-3)}, rate=2.0), "delta_psnr") == (3, 3)


def test_a_row_says_what_there_is_to_follow():
    rows, truth = controllability({0: model(1.0)}, rate=2.0), read_shares()
    for row in rows:
        assert row.explained == truth[row.robot].share if row.robot in truth else np.isnan(row.explained)
    assert {row.robot for row in rows} >= {"mine", sorted(truth)[0]}


@pytest.mark.parametrize("rate", [4.0, None])
def test_what_there_is_to_follow_is_of_the_rate_at_which_it_was_measured(rate):
    """The share over one step at 2 Hz stood beside models of 4 to 6 Hz."""
    assert all(np.isnan(row.explained) for row in controllability({0: model(1.0)}, rate=rate))


def test_seeds_that_differ_make_the_error_larger():
    one = controllability({0: model(1.0)}, rate=2.0)
    three = controllability({s: model(1.0, shift=s) for s in range(3)}, rate=2.0)
    own = [next(r for r in rows if r.metric == "delta_psnr") for rows in (one, three)]
    assert own[1].seeds == 3 and own[1].sem > 3 * own[0].sem
    assert own[1].mean == pytest.approx(own[0].mean + 1)


def test_seeds_are_compared_window_by_window_in_whatever_order_they_have_them():
    one, other = model(1.0), model(0.5)
    mixed = other.rows(np.random.default_rng(0).permutation(len(other)))
    straight, shuffled = (controllability({0: one, 1: table}, rate=2.0) for table in (other, mixed))
    for a, b in zip(straight, shuffled, strict=True):
        assert (a.robot, a.metric) == (b.robot, b.metric)
        np.testing.assert_allclose([a.mean, a.sem, a.low, a.high], [b.mean, b.sem, b.low, b.high], rtol=1e-6)
