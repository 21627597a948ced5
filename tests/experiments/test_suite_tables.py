"""The committed measurements of the suite: what they say, and that the simulator still gives them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.suite.embodiments import EMBODIMENTS, siblings
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.world import World
from experiments.analysis.explained_share import EXPLAINED, read_shares
from experiments.suite import explained as explained_module
from experiments.suite import siblings as siblings_module
from experiments.suite import tokenizer as tokenizer_module
from experiments.suite.explained import explained
from experiments.suite.siblings import OUT, Samples, gain, judge, predictor, sample
from experiments.suite.tokenizer import quality

BY_NAME = {s.name: s for s in EMBODIMENTS}


def sibling_rows() -> dict[str, dict[str, str]]:
    with OUT.open(newline="") as file:
        return {row["family"]: row for row in csv.DictReader(file)}


def test_the_committed_tables_are_the_defaults_in_any_working_directory(tmp_path, monkeypatch):
    """Two commands wrote a table below the directory in which they were started."""
    monkeypatch.chdir(tmp_path)
    assert all(table.is_file() for table in (EXPLAINED, siblings_module.OUT, tokenizer_module.OUT))


def test_actions_explain_enough_of_what_changes():
    table = read_shares()
    assert list(table) == list(BY_NAME)
    assert sum(row.share >= 0.3 for row in table.values()) >= 40
    assert all(row.sem < 0.05 and row.moved > 3 for row in table.values())


@pytest.mark.parametrize("name", ["pusher_sand", "picker_slate"])
def test_the_simulator_still_gives_the_committed_shares(name):
    now, then = explained(BY_NAME[name]), read_shares()[name]
    assert now.share == pytest.approx(then.share, abs=2e-3)
    assert now.moved == pytest.approx(then.moved, abs=0.05)


@pytest.mark.slow
def test_as_many_episodes_begin_with_their_goal_reached_as_the_page_says():
    page = " ".join((Path(__file__).parents[2] / "docs/suite.md").read_text().split())
    rates = {}
    for spec in EMBODIMENTS:
        begun = World(spec, episode_seeds(spec, 2000, 0, "val")).success().mean()
        rates.setdefault(spec.family, []).append(round(100 * begun))
    often = [rate for name in ("gripper", "humanoid", "pusher", "rover", "omni") for rate in rates.pop(name)]
    both = rates.pop("bimanual")
    assert f"{min(often)} to {max(often)} % of those of the families" in page
    assert f"{min(both)} to {max(both)} % of `bimanual`" in page
    assert max(max(each) for each in rates.values()) <= 1
    spec = BY_NAME["pusher_sand"]
    rollout = simulate(spec, episode_seeds(spec, 500, 0, "val"))
    begun = World(spec, rollout.seeds).success()
    assert f"{100 * rollout.success.mean():.0f} % succeed, and two fifths of these began so" in page
    assert begun[rollout.success].mean() == pytest.approx(0.4, abs=0.02)


def test_actions_that_do_nothing_explain_nothing(monkeypatch):
    spec = BY_NAME["pusher_sand"]
    own = explained_module.simulate

    def idle(*arguments):
        rollout = own(*arguments)
        rollout.actions[:] = 0
        return rollout

    monkeypatch.setattr(explained_module, "simulate", idle)
    monkeypatch.setattr(explained_module, "frames_of", _moved_by_itself(explained_module.frames_of))
    assert explained(spec, states=12).share < 0.02


def _moved_by_itself(frames_of):
    """Frames to which something is added that no action has a part in."""
    calls = []

    def frames(spec, state):
        calls.append(len(state.q))
        return frames_of(spec, state) + 40.0 * (len(calls) - 1)

    return frames


def test_siblings_share_dynamics_in_every_family():
    rows = sibling_rows()
    assert set(rows) == {s.family for s in EMBODIMENTS}
    for family, row in rows.items():
        assert float(row["over_strangers_low"]) > 0, family
        assert float(row["over_shuffled_low"]) > 0, family
        assert float(row["siblings"]) < 0.5, f"{family}: half of the motion is not predicted"
    errors = {
        name: [round(100 * float(row[name])) for row in rows.values()] for name in ("siblings", "strangers", "shuffled")
    }
    page = " ".join((Path(__file__).parents[2] / "docs" / "suite.md").read_text().split())
    assert f"is {min(errors['siblings'])} to {max(errors['siblings'])} % if fitted on the four siblings" in page
    said = f"{min(errors['strangers'])} % or more if fitted on four robots of another family with equally many action values"
    assert said in page
    assert f"{min(errors['shuffled'])} % or more if fitted on the siblings with shuffled actions" in page
    shares = [round(100 * row.share) for row in read_shares().values()]
    assert f"actions explain {min(shares)} to {max(shares)} % of the change of its pixels" in page


def test_a_prediction_from_siblings_uses_the_actions():
    """Small: one robot of one family; with other actions the prediction is another, and worse."""
    spec = BY_NAME["pusher_sand"]
    samples = {s.name: sample(s, 2, episodes=12) for s in (spec, *siblings(spec))}
    target = samples.pop(spec.name)
    predict = predictor(list(samples.values()))
    shuffled = Samples(
        target.features, np.random.default_rng(0).permutation(target.actions), target.moves, target.episode
    )
    right, wrong = (((predict(s) - target.moves) ** 2).sum(1).mean() for s in (target, shuffled))
    assert right < 0.4 * wrong


def test_about_nineteen_of_twenty_intervals_of_a_gain_hold_the_truth():
    """Of five robots, whose gains differ; 16 would be held by percentiles of resampled robots."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(400):
        own = [np.zeros(8)] * 5
        control = [1.0 + 0.3 * rng.standard_normal() + 0.1 * rng.standard_normal(8) for _ in own]
        mean, low, high = gain(control, own)
        assert mean == pytest.approx(np.mean(control))
        held += low <= 1.0 <= high
    assert 0.92 <= held / 400 <= 0.98  # 0.95 ± 0.011


@pytest.mark.slow
def test_the_simulator_still_gives_the_committed_sibling_figures():
    family = [s for s in EMBODIMENTS if s.family in ("pusher", "rover")]
    result, row = judge("pusher", {s.name: sample(s, 3) for s in family}), sibling_rows()["pusher"]
    for name in ("siblings", "strangers", "shuffled"):
        assert getattr(result, name) == pytest.approx(float(row[name]), abs=5e-3)
    for name in ("over_strangers", "over_shuffled"):
        then = [float(row[column]) for column in (name, f"{name}_low", f"{name}_high")]
        assert getattr(result, name) == pytest.approx(then, abs=2e-2)


def test_pixels_that_change_are_judged_by_themselves():
    pairs = np.zeros((1, 2, 4, 4, 3), np.uint8)
    pairs[0, 1, 0] = 200  # one row of four changes
    decoded = pairs[:, 1].astype(float)
    decoded[0, 0] += 25.5  # and is wrong by a tenth of the range
    mean, changed, share = quality(decoded, pairs)
    assert share == pytest.approx(0.25)
    assert changed == pytest.approx(20.0) and mean == pytest.approx(20 + 10 * np.log10(4))
