"""Points at the number of steps that suits them."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.best_steps import _judge, cross_fit, halves, judge_at_best
from experiments.analysis.paired import NotComparable
from experiments.report.sweeps import AxisStatistics, describe
from experiments.running.trial import trial_id
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import POINT, Sweep
from tests.experiments.analysis.worlds import judged, with_loss
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, windows_of

ROBOTS = ("r0", "r1")


def noisy(rng, table, shift=0.0):
    """The same windows; episodes differ by chance."""
    of_episode = {key: rng.normal() for key in zip(table.dataset.tolist(), table.episode.tolist(), strict=True)}
    noise = [of_episode[key] for key in zip(table.dataset.tolist(), table.episode.tolist(), strict=True)]
    return with_loss(table, table.metrics["cross_entropy"] + shift + np.array(noise))


def test_steps_are_not_chosen_on_the_episodes_that_judge():
    """Five equally good models: the lowest of their losses is too low, the cross-fitted one is not."""
    best, fitted = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        table = judged(rng, robots=2, episodes=8, each=1, mean=2.0, of_episode=0.0, of_window=0.0)
        tables = {steps: noisy(rng, table) for steps in range(5)}
        best.append(min(t.metrics["cross_entropy"].mean() for t in tables.values()))
        fitted.append(cross_fit(tables, ROBOTS)[0].metrics["cross_entropy"].mean())
    assert np.mean(best) < 1.8
    assert abs(np.mean(fitted) - 2.0) < 3 * np.std(fitted) / np.sqrt(len(fitted))


def test_the_better_steps_are_found_and_every_window_is_judged_once():
    rng = np.random.default_rng(0)
    table = judged(rng, robots=2, episodes=8, mean=2.0)
    tables = {100: noisy(rng, table, 5.0), 200: table}
    whole, chosen = cross_fit(tables, ROBOTS)
    assert chosen == (200, 200)
    np.testing.assert_array_equal(whole.metrics["cross_entropy"], table.metrics["cross_entropy"])
    half = halves(table)
    for robot in ROBOTS:
        own = table.dataset == robot
        sides = [set(table.episode[own & (half == h)].tolist()) for h in (0, 1)]
        assert not sides[0] & sides[1] and len(sides[0]) == len(sides[1]) == 4
    with pytest.raises(NotComparable):
        cross_fit({100: table, 200: replace(table, episode=table.episode + 1)}, ROBOTS)


def test_windows_are_matched_in_whatever_order_they_stand():
    """Else steps were chosen on episodes that they are judged on."""
    rng = np.random.default_rng(0)
    table = judged(rng, robots=2, episodes=8, mean=2.0)
    first, second = (noisy(rng, table) for _ in range(2))
    mixed = second.rows(rng.permutation(len(second)))
    (straight, chosen), (shuffled, again) = (cross_fit({1: first, 2: other}, ROBOTS) for other in (second, mixed))
    assert chosen == again
    np.testing.assert_array_equal(straight.metrics["cross_entropy"], shuffled.metrics["cross_entropy"])


def test_steps_at_either_end_of_those_tried_are_said_to_be():
    """Fewer or more may be better still."""
    table = judged(np.random.default_rng(0), robots=2, episodes=4)
    sweep = Sweep("episodes", "episodes", ROBOTS, ())
    edges = []
    for best in (100, 200, 300):
        tables = {n: with_loss(table, np.full(len(table), 9.0 if n != best else 1.0)) for n in (100, 200, 300)}
        edges.append({row.edge for row in _judge(sweep, 1.0, {0: tables})})
    assert edges == [{"edge"}, {""}, {"edge"}]


def test_robots_of_one_episode_take_turns_to_choose_and_to_judge():
    """Of 500 steps and 1,000 the better are chosen, also where every robot has one episode."""
    table = judged(np.random.default_rng(0), robots=2, episodes=1)
    tables = {steps: with_loss(table, np.full(len(table), loss)) for steps, loss in ((500, 9.0), (1000, 1.0))}
    whole, chosen = cross_fit(tables, ROBOTS)
    assert chosen == (1000, 1000) and set(whole.metrics["cross_entropy"]) == {1.0}
    with pytest.raises(NotComparable, match="there is only one episode"):
        cross_fit(tables, ROBOTS[:1])


def test_a_point_that_one_episode_judges_is_left_out():
    named = replace(WIDE, datasets=("pusher_sand", "arm_sand", "rover_road"))
    study = replace(named, designs=replace(WIDE.designs, caps=(2,)), train=replace(WIDE.train, steps=8))
    (sweep,) = plan_sweeps(study, ("episodes",))
    tables = {trial_id(p.trial, PROVENANCE): windows_of(p.trial) for p in sweep.points}
    assert judge_at_best([sweep], PROVENANCE, tables)
    fewest = min(p.x for p in sweep.points)
    for point in (p for p in sweep.points if p.x == fewest):
        id = trial_id(point.trial, PROVENANCE)
        tables[id] = tables[id].among(["pusher_sand"]).rows(np.arange(2))
    assert fewest not in {row.x for row in judge_at_best([sweep], PROVENANCE, tables)}


def test_trials_that_differ_in_more_than_steps_are_not_taken_for_one_another():
    """Of series of two widths, the windows of one stood in the other's place."""
    named = replace(WIDE, datasets=("pusher_sand", "arm_sand", "rover_road"))
    study = replace(named, designs=replace(WIDE.designs, caps=(2,)), train=replace(WIDE.train, steps=8))
    (sweep,) = plan_sweeps(study, ("episodes",))
    most = max(p.x for p in sweep.points)
    wider = [
        replace(p, trial=replace(p.trial, model=replace(p.trial.model, width=64)), series=f"wide {p.series}")
        for p in sweep.points
        if p.role == POINT and p.x == most and p.trial.train.seed == 0
    ]
    sweep = replace(sweep, points=(*sweep.points, *wider))
    tables = {trial_id(p.trial, PROVENANCE): windows_of(p.trial) for p in sweep.points}
    rows = {row.x: row for row in judge_at_best([sweep], PROVENANCE, tables) if row.metric == "cross_entropy"}
    assert rows[most].seeds == 2 and all(row.seeds == 3 for x, row in rows.items() if x != most)


def test_the_axis_of_trajectories_is_judged_at_its_best_steps():
    named = replace(WIDE, datasets=("pusher_sand", "arm_sand", "rover_road"))
    study = replace(named, designs=replace(WIDE.designs, caps=(2,)), train=replace(WIDE.train, steps=8))
    (sweep,) = plan_sweeps(study, ("episodes",))
    tables = {}
    for point in sweep.points:
        longer = point.trial.train.steps == 8
        table = windows_of(point.trial)
        scarce = point.trial.max_trajectories == 2
        worse = 1.0 if longer == scarce else 0.0  # scarce data: fewer steps; all data: more
        nats = np.where(table.dataset == "arm_sand", np.nan, 1.0)  # it has no actions
        table = replace(table, metrics={**table.metrics, "action_nats": nats})
        tables[trial_id(point.trial, PROVENANCE)] = with_loss(table, table.metrics["cross_entropy"] + worse)
    found = judge_at_best([sweep], PROVENANCE, tables)
    assert "At the best number of steps for each point" in describe(sweep, [], AxisStatistics(best=found))
    assert {r.mean for r in found if r.metric == "action_nats"} == {1.0}, "of the robots that have it"
    rows = {r.x: r for r in found if r.metric == "cross_entropy"}
    fewest, most = min(rows), max(rows)
    assert rows[fewest].chosen == "2 x 6" and rows[most].chosen == "8 x 6" and rows[most].seeds == 3
    assert abs(rows[fewest].mean - rows[most].mean) < 0.1
