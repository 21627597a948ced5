"""Measures of how two worlds agree about policies, on cases that are known."""

import numpy as np
import pytest

from experiments.applications.judging import agreement
from experiments.applications.judging.agreement import (
    LEAST_POLICIES,
    LEAST_STARTS,
    MEASURES,
    agree,
    agree_with_counts,
    count_interval,
    mean_above,
    pearson,
    rank_violation,
    rate_interval,
    share,
    spearman,
)
from experiments.applications.judging.doubts import describe_few_starts, describe_one_apart
from experiments.applications.judging.head import auroc


def test_measures_of_known_cases():
    true, learned = np.array([0.38, 0.52, 0.70, 1.00]), np.array([0.40, 0.45, 0.55, 0.99])
    assert pearson(true, learned) == pytest.approx(np.corrcoef(true, learned)[0, 1])
    assert spearman(true, learned) == 1 and rank_violation(true, learned) == 0
    # 0.5 and 0.6 are exchanged; the others are as they should be.
    assert rank_violation(np.array([0.1, 0.5, 0.6]), np.array([0.0, 0.9, 0.8])) == pytest.approx(0.2 / 3)
    assert rank_violation(np.array([0.8, 0.2]), np.array([0.5, 0.5])) == pytest.approx(0.6)
    assert np.isnan(pearson(true, np.ones(4))) and np.isnan(rank_violation(np.ones(4), true))
    alike = np.full(11, 0.86)
    assert (alike - alike.mean()).any() and np.isnan(pearson(np.arange(11.0), alike))


def test_a_faithful_world_has_a_high_interval_and_one_without_relation_has_none():
    rng = np.random.default_rng(0)
    rates = np.linspace(0.05, 0.95, 9)
    true = rng.random((9, 60)) < rates[:, None]
    faithful = agree(true, rng.random((9, 60)) < rates[:, None], draws=300).measures["pearson"]
    blind = agree(true, rng.random((9, 60)) < 0.4, draws=300).measures["pearson"]
    assert faithful.low > 0.7 and faithful.low < faithful.mean < faithful.high
    assert blind.low < 0 < blind.high
    starts = agree(true, true, draws=100).over_starts["bias"]
    assert (starts.mean, starts.low, starts.high) == (0, 0, 0)


@pytest.mark.parametrize(("least", "most"), [(0.05, 0.95), (0.4, 0.6)])
def test_intervals_over_starts_hold_what_more_starts_would_show(least, most):
    """Resamples have the noise of the starts twice. Where true rates differ by little more than it, intervals around
    the measured value missed half of the correlations of such faithful worlds, all of them above."""
    rng, held = np.random.default_rng(0), {"pearson": 0, "spearman": 0, "rank violation": 0}
    for _ in range(24):
        true, noise = rng.uniform(least, most, (2, 8))
        rates = true, 0.9 * true + 0.1 * noise
        found = agree(*(rng.random((8, 30)) < rate[:, None] for rate in rates), draws=100).over_starts
        for name in held:
            held[name] += found[name].low <= MEASURES[name](*rates) <= found[name].high
    assert min(held.values()) >= 20, held


def test_an_interval_over_starts_contains_what_was_measured(monkeypatch):
    """Noise may have put that outside of all true rates that are drawn."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(agreement, "draw_rates", lambda measured, noise, draws: rng.random((draws, *measured.shape)))
    true = rng.random((8, 30)) < np.linspace(0.1, 0.9, 8)[:, None]
    same, opposite = (agree(true, learned, draws=20).over_starts["pearson"] for learned in (true, ~true))
    assert same.low < 0.9 < same.high == pytest.approx(same.mean) == 1
    assert opposite.high > -0.9 > opposite.low == pytest.approx(opposite.mean) == -1


def test_starts_that_worlds_share_make_no_correlation_of_policies_that_are_alike():
    """A start that is hard in both worlds, and one that a policy fails in both, are not a matter of its true rate."""
    rng, intervals = np.random.default_rng(0), []
    for _ in range(8):
        true = rng.random((8, 30)) < 0.5
        learned = np.where(rng.random((8, 30)) < 0.8, true, rng.random((8, 30)) < 0.5)
        found = agree(true, learned, draws=100).over_starts["pearson"]
        intervals.append((found.mean, found.low))
    means, lows = np.array(intervals).T
    assert means.min() > 0.4 and sum(lows < 0) >= 7


def test_other_policies_could_agree_less_however_many_starts_there_are():
    """What 400 starts say of 8 policies is sure; what they say of policies of their kind is not."""
    rng, true = np.random.default_rng(0), np.linspace(0.1, 0.9, 8)
    learned = np.clip(true + rng.normal(0, 0.2, 8), 0, 1)
    found = agree(*(rng.random((8, 400)) < rates[:, None] for rates in (true, learned)), draws=200)
    over_policies, over_starts = found.measures["pearson"], found.over_starts["pearson"]
    assert over_policies.high - over_policies.low > 2 * (over_starts.high - over_starts.low)


def test_too_few_starts_have_no_interval_over_starts_but_of_the_bias():
    rng = np.random.default_rng(0)
    for starts, known in ((LEAST_STARTS - 1, False), (LEAST_STARTS, True)):
        found = agree(*(rng.random((2, 8, starts)) < np.linspace(0.1, 0.9, 8)[:, None]), draws=50).over_starts
        assert {np.isfinite(found[name].low) for name in MEASURES if name != "bias"} == {known}
        assert np.isfinite(found["bias"].low)


def test_one_policy_that_is_far_from_others_does_not_stand_for_their_order():
    """Of ten that are alike and one that is worse in both worlds, which have no more in common, Pearson's is high."""
    rng, rates = np.random.default_rng(0), np.array([0.2] + 10 * [0.9])
    found = agree(*(rng.random((2, 11, 50)) < rates[:, None]), draws=100).over_starts
    assert found["pearson"].low > 0.5 and np.isfinite(found["rank violation"].low)
    assert np.isfinite(found["spearman"].mean) and np.isnan(found["spearman"].low)


@pytest.mark.parametrize("always", [False, True])
def test_one_episode_does_not_take_a_policy_from_the_others(always):
    """Of policies that all but always succeed, or fail, one of fifty episodes that ends otherwise is noise."""
    true = np.full((11, 50), always)
    learned = true.copy()
    true[0, 3] = learned[1, 4] = not always
    assert np.isfinite(agree(true, learned, draws=100).over_starts["spearman"].low)


def test_the_page_says_why_there_is_no_interval_over_starts():
    without, known = {"mean": 0.5, "low": None, "high": None}, {"mean": 0.5, "low": 0.1, "high": 0.9}
    for starts, spearmans, few, apart in ((LEAST_STARTS - 1, without, True, False), (LEAST_STARTS, without, False, True),
                                          (LEAST_STARTS, known, False, False)):  # fmt: skip
        agreed = {"learned model": {"starts": {"spearman": spearmans}}}
        summary = {"starts": starts, "compared with": "true, by state", "agreement": agreed}
        assert (describe_few_starts(summary) != "", describe_one_apart(summary) != "") == (few, apart)


def test_few_policies_have_no_interval_over_policies_and_two_no_correlation():
    """A resample of two has one of them, or a correlation of 1 or -1: the interval was 1.00 to 1.00."""
    rng = np.random.default_rng(0)
    for policies in (2, 3, LEAST_POLICIES - 1, LEAST_POLICIES):
        true, learned = (rng.random((policies, 40)) < np.linspace(0.1, 0.9, policies)[:, None] for _ in range(2))
        found = agree(true, learned, draws=100)
        for name in ("pearson", "spearman", "rank violation"):
            over_policies, over_starts = found.measures[name], found.over_starts[name]
            assert np.isfinite(over_policies.low) == (policies >= LEAST_POLICIES), (policies, name)
            known = policies > 2 or name == "rank violation"
            assert np.isfinite(over_policies.mean) == np.isfinite(over_starts.low) == known, (policies, name)
        assert found.measures["bias"].low < found.measures["bias"].high


def test_a_robot_that_always_or_never_succeeded_leaves_doubt():
    learned = np.repeat([[False], [True], [True]], 40, 1)
    found = agree_with_counts(np.array([0, 3, 3]), np.array([3, 3, 3]), learned, draws=200)
    assert found.measures["pearson"].mean == pytest.approx(1) and found.over_starts["pearson"].low < 0.95
    assert found.over_starts["bias"].low < -0.05 and found.over_starts["bias"].high > 0.05


def test_policies_that_are_all_alike_are_not_sure_to_be():
    none = count_interval(0, 40).high  # of 40 episodes, so many may be otherwise
    every, no = np.ones((4, 10), bool), np.zeros((4, 10), bool)
    for a, b, low, mean, high in (
        (every, no, 1 - none, 1, 1), (no, every, -1, -1, none - 1), (every, every, -none, 0, none)
    ):  # fmt: skip
        above = mean_above(a, b, draws=20)
        assert (above.low, above.mean, above.high) == pytest.approx((low, mean, high))


def test_intervals_of_rates_hold_at_the_ends():
    none, some = rate_interval(np.zeros(50)), rate_interval(np.arange(50) < 25)
    assert none.low == pytest.approx(0, abs=1e-12) and none.high == pytest.approx(0.0713, abs=1e-3)
    assert (some.low, some.high) == (pytest.approx(0.3664, abs=1e-3), pytest.approx(0.6336, abs=1e-3))
    for n in range(1, 300):  # of which rounding takes a third beyond the ends
        assert rate_interval(np.zeros(n)).low == 0 and rate_interval(np.ones(n)).high == 1


def test_a_share_of_episodes_takes_policies_and_starts_for_what_varies():
    rng = np.random.default_rng(0)
    everything = np.ones((8, 50), bool)
    by_policy = np.repeat(np.arange(8) < 4, 50).reshape(8, 50)  # four policies are judged rightly, four wrongly
    scattered = rng.permutation(by_policy.ravel()).reshape(8, 50)
    clustered, alone = share(by_policy, everything, draws=500), share(scattered, everything, draws=500)
    assert clustered.mean == alone.mean == 0.5
    assert clustered.high - clustered.low > 3 * (alone.high - alone.low)
    wilson = rate_interval(np.ones(50))
    always = share(everything, everything & (np.arange(8)[:, None] == 0), draws=500)  # all of one policy, all alike
    assert (always.low, always.high) == (wilson.low, pytest.approx(1))


def test_auroc_counts_ties_half():
    assert auroc(np.array([0.1, 0.4, 0.4, 0.9]), np.array([0, 0, 1, 1])) == pytest.approx(0.875)
