"""Two models side by side: what differs, by how much, and what cannot be compared."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.compare import Side, compare, overall_difference
from experiments.analysis.intervals import OVERALL
from experiments.analysis.paired import NoNumbers, NotComparable
from hma_jax.evaluation.summary import paired_difference
from tests.experiments.analysis.worlds import intervals, judged, under_seeds, with_loss


def sides(gain: float = 0.2, seeds: int = 1, robots: int = 3):
    rng = np.random.default_rng(0)
    table = judged(rng, robots=robots, mean=2.0)
    nats = np.where(table.dataset == "r0", np.nan, rng.normal(size=len(table)))
    table = replace(table, metrics={**table.metrics, "action_nats": nats})
    better = with_loss(table, table.metrics["cross_entropy"] - gain)
    a, b = (under_seeds(x, rng, seeds, 0.01 * (seeds > 1), 0.05) for x in (better, table))
    return Side("a", a, "t"), Side("b", b, "t")


def test_one_seed_is_the_paired_interval_clustered_by_episode():
    a, b = sides()
    rows = {(r.scope, r.metric): r for r in compare(a, b)}
    want = intervals(paired_difference(a.seeds[0], b.seeds[0], 1))
    for scope in (OVERALL, "r0", "r1", "r2"):
        row, interval = rows[scope, "cross_entropy"], want[scope]["cross_entropy"]
        assert (row.mean, row.sem, row.low, row.high) == pytest.approx(
            (interval.mean, interval.sem, interval.low, interval.high)
        )
        assert row.ratio == pytest.approx(np.exp(row.mean)) and row.ratio_low < row.ratio < row.ratio_high
        assert row.a - row.b == pytest.approx(row.mean)
    assert rows[OVERALL, "cross_entropy"].errors < -5
    assert next(iter(rows)) == (OVERALL, "cross_entropy") and not any(m == "psnr_copy" for _, m in rows)


def test_what_windows_alone_decide_is_not_compared():
    """LPIPS of copying the last frame was a row of zeros."""
    a, b = sides()
    for side in (a, b):
        table = side.seeds[0]
        table.metrics.update(lpips=np.full(len(table), 0.1), lpips_copy=np.full(len(table), 0.2))
    metrics = {row.metric for row in compare(a, b)}
    assert "lpips" in metrics and "lpips_copy" not in metrics


@pytest.mark.parametrize(("tokenizer", "metric", "said"), [
    ("t", "action_error", "a has cross_entropy, .*, b has action_error$"),
    ("other", "cross_entropy", r".*, b has cross_entropy; nats are not compared, .* differ \(t, other\)"),
])  # fmt: skip
def test_two_models_without_a_metric_in_common_are_refused(tokenizer, metric, said):
    """As a policy beside a model of frames: they were an empty table, and no error."""
    a, b = sides()
    table = b.seeds[0]
    table = replace(table, metrics={metric: np.ones(len(table)), "psnr_copy": table.metrics["psnr_copy"]})
    with pytest.raises(NotComparable, match=f"no metric can be compared: {said}"):
        compare(a, replace(b, seeds={0: table}, tokenizer=tokenizer))


def test_what_some_robots_have_not_is_over_the_others():
    rows = {(r.scope, r.metric): r for r in compare(*sides())}
    assert ("r0", "action_nats") not in rows and rows[OVERALL, "action_nats"].n == 2 * 48
    assert rows[OVERALL, "action_nats"].mean == rows[OVERALL, "action_nats"].errors == 0


def test_a_model_that_broke_on_some_windows_is_refused():
    """They were left out of both, and a robot of nothing else vanished from the mean over robots."""
    a, b = sides()
    nats = b.seeds[0].metrics["cross_entropy"]
    broken = with_loss(b.seeds[0], np.where(b.seeds[0].dataset == "r1", np.nan, nats))
    with pytest.raises(
        NotComparable, match=r"b has no cross_entropy of window \(r1, episode 100, frame 0\) \(and 47 oth"
    ):
        compare(a, replace(b, seeds={0: broken}))
    other = replace(a, seeds={0: a.seeds[0].among(("r0", "r2"))})
    assert compare(other, replace(b, seeds={0: broken})), "a robot that is not compared"


def test_a_metric_that_some_windows_lack_is_lacked_by_both_models_or_refused():
    """Windows of which one alone had action-nats were left out of both."""
    a, b = sides()
    nats = a.seeds[0].metrics["action_nats"].copy()
    nats[np.flatnonzero(a.seeds[0].dataset == "r2")[1:3]] = np.nan
    table = a.seeds[0]
    broken = Side("a", {0: replace(table, metrics=table.metrics | {"action_nats": nats})}, "t")
    for pair in ((broken, b), (b, broken)):
        with pytest.raises(NoNumbers, match=r"^a has no action_nats of window \(r2, .*\) \(and 1 others\)"):
            compare(*pair)
        with pytest.raises(NoNumbers):
            overall_difference(*pair, "action_nats", table.datasets)


def test_several_seeds_are_paired_by_name_and_their_scatter_counts():
    a, b = sides(seeds=3)
    rows = {(r.scope, r.metric): r for r in compare(a, b)}
    row = rows[OVERALL, "cross_entropy"]
    assert row.seeds == 3 and row.low < -0.2 < row.high < 0
    backwards = Side("b", dict(reversed(b.seeds.items())), "t")
    again = {(r.scope, r.metric): r for r in compare(a, backwards)}
    assert again[OVERALL, "cross_entropy"].mean == pytest.approx(row.mean)
    with pytest.raises(NotComparable, match="a has seeds 0, 1, 2 and c 7, 8: none in common"):
        compare(a, Side("c", {7: b.seeds[0], 8: b.seeds[1]}, "t"))
    (one,) = [r for r in compare(a, Side("c", {2: b.seeds[2]}, "t")) if (r.scope, r.metric) == ("r1", "cross_entropy")]
    assert one.seeds == 1


def test_retrieval_among_other_numbers_is_not_compared():
    """The true actions are found by chance once in four, or once in sixteen."""

    def among(side, number):
        chance = {
            "retrieval": np.zeros(len(side.seeds[0])),
            "retrieval_chance": np.full(len(side.seeds[0]), 1 / number),
        }
        return replace(side, seeds={s: replace(t, metrics=t.metrics | chance) for s, t in side.seeds.items()})

    a, b = sides()
    alike, other = compare(among(a, 4), among(b, 4)), compare(among(a, 4), among(b, 16))
    assert any(r.metric == "retrieval" for r in alike)
    by_robot = np.where(a.seeds[0].dataset == "r0", 4, 16)
    mine, theirs = among(a, by_robot), among(b, by_robot)
    backwards = replace(theirs, seeds={0: theirs.seeds[0].rows(np.arange(len(by_robot))[::-1])})
    assert any(r.metric == "retrieval" for r in compare(mine, backwards))
    assert not any(r.metric.startswith("retrieval") for r in other) and any(r.metric == "action_nats" for r in other)


def test_nats_of_other_tokens_are_not_compared():
    a, b = sides()
    assert {r.metric for r in compare(a, b)} == {"cross_entropy", "action_nats"}
    psnr = {s: replace(t, metrics={**t.metrics, "psnr": t.metrics["psnr_copy"] + s}) for s, t in a.seeds.items()}
    other = Side("b", psnr, "u")
    assert {r.metric for r in compare(Side("a", psnr, "t"), other)} == {"psnr"}


def test_losses_of_other_noising_processes_are_not_compared():
    """The same network has a larger loss in fewer steps, since its bound is then a sum of fewer, larger terms."""
    table = sides()[0].seeds[0]
    metrics = dict.fromkeys(("diffusion_loss", "action_nats", "psnr"), table.metrics["cross_entropy"])
    seeds = {0: replace(table, metrics=metrics)}
    many, few, unknown = (Side(str(n), seeds, "t", noising_steps=n) for n in (1000, 20, 0))
    assert {r.metric for r in compare(many, few)} == {"psnr"}
    assert {r.metric for r in compare(many, many)} == {r.metric for r in compare(many, unknown)} == set(metrics)


def test_other_windows_are_refused():
    a, b = sides()
    table = b.seeds[0]
    with pytest.raises(NotComparable, match=r"window \(r0, episode 100, frame 0\) differs between the two"):
        compare(a, Side("b", {0: replace(table, frames=table.frames - 1)}, "t"))
