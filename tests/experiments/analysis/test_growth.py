"""Robots whose data still grows are told from those whose data is exhausted."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.growth import EXHAUSTED, GROWS, find_growth
from experiments.analysis.paired import NotComparable
from experiments.report.numbers import find_fewer, find_other_x
from experiments.report.sweeps import AxisStatistics, describe
from experiments.running.trial import trajectories_of, trial_id
from experiments.sweeps.registry import plan_sweeps
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, windows_of

THERE = {"pusher_sand": 3, "arm_sand": 40, "rover_road": 8}
STUDY = replace(
    WIDE, tau=1000.0, datasets=tuple(THERE), trajectory_counts=(1000,), train=replace(WIDE.train, steps=8),
    designs=replace(WIDE.designs, caps=(2, 8)),
)  # fmt: skip
(SWEEP,) = plan_sweeps(STUDY, ("episodes",))


def tables(gain: float = -0.5):
    """Losses that change by `gain` per step of the cap on robots that get more from it, and on no others."""
    found = {}
    for point in SWEEP.points:
        table, capped_before = windows_of(point.trial), [n for n in (2, 8) if n < (point.trial.max_trajectories or 99)]
        gains = [sum(cap < THERE[name] for cap in capped_before) * gain for name in table.dataset]
        found[trial_id(point.trial, PROVENANCE)] = replace(table, metrics={"cross_entropy": 5.0 + np.array(gains)})
    return found


def test_only_robots_that_get_more_trajectories_count_as_growing():
    rows = {(r.series, r.first, r.data): r for r in find_growth([SWEEP], PROVENANCE, tables(), {}, THERE)}
    first, second, last = sorted({p.x for p in SWEEP.points})
    for series in {p.series for p in SWEEP.points if p.series}:
        assert rows[series, first, GROWS].robots == 3 and (series, first, EXHAUSTED) not in rows
        assert (rows[series, second, GROWS].robots, rows[series, second, EXHAUSTED].robots) == (1, 2)
        assert rows[series, second, GROWS].mean == pytest.approx(-0.5)
        assert rows[series, second, EXHAUSTED].mean == pytest.approx(0.0, abs=1e-9)
        assert rows[series, second, GROWS].last == last and rows[series, first, GROWS].seeds == 3


@pytest.mark.parametrize("later_seeds", [2, 3])
def test_a_robot_grows_only_where_its_trials_were_trained_on_more(later_seeds):
    """Of a subset that was drawn, damaged trajectories are not replaced. One seed that has more is enough."""
    results = {
        trial_id(p.trial, PROVENANCE): {
            "trajectories": dict.fromkeys(THERE, later_seeds if cap == 8 and p.trial.train.seed else 2)
        }
        for p in SWEEP.points
        if (cap := p.trial.max_trajectories or 99) <= 8
    }
    rows = {(r.first, r.data): r.robots for r in find_growth([SWEEP], PROVENANCE, tables(), results, THERE)}
    first, second, _ = sorted({p.x for p in SWEEP.points})
    assert rows == {(first, EXHAUSTED if later_seeds == 2 else GROWS): 3, (second, GROWS): 3}


def test_what_trials_were_trained_on_is_told_where_it_is_not_what_was_asked_for():
    trials = {trial_id(p.trial, PROVENANCE): p.trial for p in SWEEP.points}
    results = {id: {"trajectories": trajectories_of(trial, THERE)} for id, trial in trials.items()}
    total = replace(SWEEP, points=tuple(
        replace(p, x=sum(trajectories_of(p.trial, THERE).values())) for p in SWEEP.points
    ))  # fmt: skip
    assert not find_fewer(trials, {}, THERE) and not find_fewer(trials, results, THERE)
    assert not find_other_x([total], PROVENANCE, {}, THERE) and not find_other_x([total], PROVENANCE, results, THERE)
    id = next(id for id, trial in trials.items() if trial.max_trajectories == 8 and trial.train.seed == 0)
    results[id] = {"trajectories": {"pusher_sand": 3, "arm_sand": 5, "rover_road": 8}}
    assert find_fewer(trials, results, THERE) == ["5 of 8 of arm_sand (seed 0)"]
    assert find_other_x([total], PROVENANCE, results, THERE) == ["16 at x = 19 (seed 0)"]


def test_no_growth_is_told_where_robots_shares_of_the_windows_change():
    def under(**change):
        points = tuple(replace(p, trial=replace(p.trial, **change)) for p in SWEEP.points)
        before = {trial_id(p.trial, PROVENANCE): t for p, t in zip(SWEEP.points, tables_of_points(), strict=True)}
        found = {trial_id(q.trial, PROVENANCE): before[trial_id(p.trial, PROVENANCE)]
                 for p, q in zip(SWEEP.points, points, strict=True)}  # fmt: skip
        return find_growth([replace(SWEEP, points=points)], PROVENANCE, found, {}, THERE)

    assert not under(tau=3.0) and under(tau=3.0, weighed="all")


def tables_of_points():
    by_id = tables()
    return [by_id[trial_id(p.trial, PROVENANCE)] for p in SWEEP.points]


def test_the_page_shows_both_groups():
    said = describe(SWEEP, [], AxisStatistics(growth=find_growth([SWEEP], PROVENANCE, tables(), {}, THERE)))
    assert "Robots whose data grows, and others" in said and "1 with more" in said and "2 with no more" in said


def test_other_windows_are_refused_and_other_axes_left_out():
    found = tables()
    id = trial_id(next(p.trial for p in SWEEP.points if p.trial.max_trajectories == 8), PROVENANCE)
    with pytest.raises(NotComparable):
        find_growth([SWEEP], PROVENANCE, found | {id: replace(found[id], episode=found[id].episode + 1)}, {}, THERE)
    (width,) = plan_sweeps(WIDE, ("width",))
    judged = {trial_id(p.trial, PROVENANCE): windows_of(p.trial) for p in width.points}
    assert not find_growth([width], PROVENANCE, judged, {}, dict.fromkeys(width.scope, 8))
