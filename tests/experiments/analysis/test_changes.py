"""What changes from one end of an axis to the other."""

import math
from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.changes import find_changes
from experiments.analysis.paired import NotComparable
from experiments.running.trial import trial_id
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import unique_trials
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, expected_loss, windows_of

(SWEEP,) = plan_sweeps(WIDE, ("width",))
TABLES = {id: windows_of(trial) for id, trial in unique_trials([SWEEP], PROVENANCE).items()}


def changed(sweep=SWEEP, tables=TABLES, metric="cross_entropy"):
    return next((c for c in find_changes([sweep], PROVENANCE, tables) if c.metric == metric), None)


def of(x: float, seed: int) -> str:
    return next(
        trial_id(p.trial, PROVENANCE)
        for p in SWEEP.points
        if p.role == "point" and p.x == x and p.trial.train.seed == seed
    )


def test_windows_that_are_hard_at_both_ends_add_nothing_to_the_error():
    change = changed()
    assert (change.first, change.last, change.seeds) == (8, 48, 3)
    ends = [TABLES[of(x, 0)].metrics["cross_entropy"] for x in (8, 48)]
    hard = ends[0].mean() / expected_loss(next(p.trial for p in SWEEP.points if p.x == 8).model)
    truth = hard * (expected_loss(next(p.trial for p in SWEEP.points if p.x == 48).model) - ends[0].mean() / hard)
    assert change.low < truth < change.high < 0
    unpaired = math.hypot(*(v.std() / math.sqrt(len(v)) for v in ends))
    assert change.sem < 0.5 * unpaired


def test_it_is_taken_between_the_outermost_points_that_are_finished():
    tables = {id: table for id, table in TABLES.items() if id not in {of(48, s) for s in range(3)} | {of(32, 1)}}
    change = changed(tables=tables)
    assert (change.last, change.seeds) == (32, 2)
    assert changed(tables={of(8, s): TABLES[of(8, s)] for s in range(3)}) is None
    assert changed(tables={of(8, 0): TABLES[of(8, 0)], of(48, 1): TABLES[of(48, 1)]}) is None


def test_other_windows_at_one_end_are_refused():
    shifted = replace(TABLES[of(48, 0)], episode=TABLES[of(48, 0)].episode + 1)
    with pytest.raises(NotComparable):
        changed(tables={**TABLES, of(48, 0): shifted})


@pytest.mark.parametrize("own_robots", [False, True])
def test_a_metric_that_a_model_lacks_somewhere_has_no_difference(own_robots):
    """The windows without it were left out, which favoured the model that broke."""
    scopes = [(robot,) if own_robots else () for robot in SWEEP.scope]
    sweep = replace(SWEEP, points=tuple(replace(p, scope=scopes[p.trial.train.seed % 3]) for p in SWEEP.points))
    table = TABLES[of(48, 0)]
    nats = np.where(np.arange(len(table)) == 0, np.nan, table.metrics["cross_entropy"])
    tables = TABLES | {of(48, 0): replace(table, metrics=table.metrics | {"cross_entropy": nats})}
    assert changed(sweep) is not None
    assert changed(sweep, tables) is None
    assert changed(sweep, tables, "delta_psnr") == changed(sweep, metric="delta_psnr")


def test_seeds_that_judge_robots_of_their_own_are_each_compared_on_these():
    robots = SWEEP.scope
    points = tuple(replace(p, scope=(robots[p.trial.train.seed % len(robots)],)) for p in SWEEP.points)
    change = changed(replace(SWEEP, points=points))
    means = []
    for seed in range(3):
        a, b = (TABLES[of(x, seed)] for x in (48, 8))
        own = a.dataset == robots[seed % len(robots)]
        means.append((a.metrics["cross_entropy"] - b.metrics["cross_entropy"])[own].mean())
    assert change.mean == pytest.approx(np.mean(means)) and change.seeds == 3
    assert change.sem == pytest.approx(np.std(means, ddof=1) / math.sqrt(3))
    same = {of(x, seed): TABLES[of(8, seed)] for x in (8, 48) for seed in range(3)}
    change = changed(replace(SWEEP, points=points), same)
    assert change.mean == change.sem == change.errors == 0
