"""The committed tables of generated trajectories and of planners follow from their trials, and the page says what they
say."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from experiments.analysis.intervals import Interval
from experiments.applications import DRIVEN, FIRST, plan_actions
from experiments.applications.generating import conditions
from experiments.applications.generating.conditions import GIVEN, MOST, PASSIVE
from experiments.applications.generating.demonstration_sources import ScriptedSource, Settings
from experiments.applications.settings_file import hash_of
from hma_jax.config.json import from_dict
from hma_jax.simulator.folder import ROBOTS, load_robots
from hma_jax.training.runs import load_model

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "experiments" / "results"


def from_settings(kind: type, path: Path, model: Path | None = FIRST):
    """`model`: None for one that is not in this repository."""
    values = json.loads(path.read_text())
    run, weights = values.pop("run"), values.pop("weights")
    assert not model or (run, weights) == (model.name, hash_of(load_model(model).params))
    values.pop("simulator", None)  # files that were written before it was kept lack it
    assert set(values) <= {f.name for f in fields(kind)}  # nor do they have fields that came later
    return from_dict(kind, values)


def summary_of(name: str, model: Path | None) -> list[conditions.Summary]:
    """Of committed trials, which `name`/table.md shows."""
    place = RESULTS / name
    settings, trials = from_settings(Settings, place / "settings.json", model), conditions.read_trials(place)
    assert set(trials) == {(i, s) for i in conditions.tried_conditions(trials) for s in settings.seeds}
    assert settings.starts >= 50 and len(settings.seeds) >= 3
    found = conditions.summarise(trials, settings.seeds)
    assert conditions.markdown(found) == (place / "table.md").read_text()
    return found


@pytest.mark.parametrize("name", ["synthetic", "synthetic_given", "synthetic_pusher"])
def test_the_committed_table_of_generated_trajectories_follows_from_its_trials(name):
    assert conditions.markdown(summary_of(name, FIRST)) in (ROOT / "docs" / "generating.md").read_text()


def said(mean: float, low: float, high: float) -> str:
    return f"{mean:.2f} ({low:.2f} to {high:.2f})"


NIGHT = {
    "synthetic_night": FIRST,
    "synthetic_night_two": FIRST,
    "synthetic_night_through": FIRST,
    "grown_night": DRIVEN,
    "grown_night_two": DRIVEN,
    "grown_night_through": DRIVEN,
}


TUNED = ("tuned_night", "tuned_night_two")
"""Of a model that was trained further on the robot."""


def page() -> str:
    """In one line."""
    return " ".join((ROOT / "docs" / "generating.md").read_text().split())


def worth(name: str, control: int, what: str = "success") -> str:
    """What policies on generated data have more of than those of a control, paired by seed, with Student's t."""
    trials = conditions.read_trials(RESULTS / name)
    seeds = sorted(seed for i, seed in trials if i == MOST)
    gain = np.array([np.mean(trials[MOST, s][what]) - np.mean(trials[control, s][what]) for s in seeds])
    half = stats.t.ppf(0.975, len(seeds) - 1) * gain.std(ddof=1) / len(seeds) ** 0.5
    assert len(seeds) == 12
    return said(gain.mean(), gain.mean() - half, gain.mean() + half)


@pytest.mark.parametrize("name", ["synthetic_given", "synthetic_pusher", "synthetic_night"])
def test_what_following_actions_is_worth_is_as_the_page_says(name):
    assert f"Following actions is worth {worth(name, PASSIVE)} of success" in page()


def test_what_generated_frames_add_to_the_recorded_ones_is_as_the_page_says():
    assert f"The generated frames are worth {worth('synthetic_given', GIVEN)} of success" in page()
    one, two, through, served, served_two, served_through = (worth(name, GIVEN) for name in NIGHT)
    assert f"worth {one} of success after one recorded frame and {two} after two" in page()
    assert f"{served} after one and {served_two} after two" in page()
    assert f"Through the tokenizer, after one, it is {through} and {served_through}." in page()
    assert (
        f"so generated frames are worth {served} of success. The first, smaller model's are worth {one} there" in page()
    )
    assert f"in action error they do: {worth('synthetic_night_two', GIVEN, 'error')}" in page()


@pytest.mark.parametrize(
    ("name", "sentence", "frames"),
    [
        ("synthetic_pusher", "{} % of the tools are on the mark in the third frame, {} % in the fourth", (2, 3)),
        ("synthetic_given", "{} % of gripper_wood's tools are above their puck in the third frame", (2,)),
        ("synthetic_night", "{}, {} and {} % of its tools are there in the first three frames", (0, 1, 2)),
    ],
)
def test_how_soon_the_task_of_the_recorded_frames_is_done_is_as_the_page_says(name, sentence, frames):
    settings = from_settings(Settings, RESULTS / name / "settings.json")
    (robot,) = (one for one in load_robots(FIRST / ROBOTS) if one.name == settings.robot)
    reached = 100 * ScriptedSource(settings, robot, 32).record().reached.mean(0)
    assert sentence.format(*(f"{reached[t]:.0f}" for t in frames)) in page()


def side_by_side(ways: list[list[conditions.Summary]], what: str) -> str:
    """Rows of a table of the page: every condition and share of the first of several runs, in all of them."""
    others = [{one.name: one.measured[what] for one in way} for way in ways]

    def cell(r: Interval | None) -> str:
        return said(r.mean, r.low, r.high) if r else "–"

    return "\n".join(f"| {one.name} | {' | '.join(cell(o.get(one.name)) for o in others)} |" for one in ways[0])


def test_what_the_served_model_s_trajectories_are_worth_is_as_the_page_says():
    """Success under three ways to begin side by side, and the shares of the gap in the error of actions."""
    ways = [summary_of(f"synthetic_grown{end}", DRIVEN) for end in ("", "_given", "_three")]
    assert side_by_side(ways, "success") in (ROOT / "docs" / "generating.md").read_text()
    closed = [next(s for s in way if s.name == "share of the gap: 10 + 90 generated") for way in ways]
    assert ", ".join(said(r.mean, r.low, r.high) for r in (one.measured["error"] for one in closed)) in page()


@pytest.mark.parametrize("what", ["success", "error"])
def test_what_trajectories_are_worth_that_outlast_their_recorded_frames_is_as_the_page_says(what):
    ways = [summary_of(name, model) for name, model in NIGHT.items()]
    assert side_by_side(ways, what) in (ROOT / "docs" / "generating.md").read_text()


@pytest.mark.parametrize("what", ["success", "error"])
def test_what_trajectories_are_worth_of_a_model_that_was_trained_further_is_as_the_page_says(what):
    assert (
        side_by_side([summary_of(name, None) for name in TUNED], what) in (ROOT / "docs" / "generating.md").read_text()
    )
    one, two = (worth(name, GIVEN) for name in TUNED)
    assert f"The generated frames are worth {one} of success after one recorded frame and {two} after two" in page()


def test_a_model_is_compared_with_what_it_was_trained_further_from_under_one_protocol():
    for before, after in zip(("grown_night", "grown_night_two"), TUNED, strict=True):
        one, other = (json.loads((RESULTS / name / "settings.json").read_text()) for name in (before, after))
        assert one.pop("simulator")["decode"] == other.pop("simulator")["decode"]
        assert {name for name, x in one.items() if other[name] != x} == {"run", "weights"}


def test_models_are_compared_under_one_protocol():
    """What is said in short held the served model's policies, which see all frames through the tokenizer, against those
    of the first model, which do not."""
    first, served = (
        json.loads((RESULTS / name / "settings.json").read_text()) for name in ("synthetic_night", "grown_night")
    )
    assert first.pop("simulator")["decode"] == served["simulator"]["decode"]
    assert {name for name, x in first.items() if served[name] != x} == {"run", "weights"}
    shares = {
        one.name.removeprefix("share of the gap: "): one.measured["success"]
        for one in summary_of("grown_night", DRIVEN)
        if one.name.startswith("share")
    }
    ours, given = (
        said(r.mean, r.low, r.high) for r in (shares["10 + 90 generated"], shares["recorded first frames only"])
    )
    assert f"after one recorded frame close {ours} of the gap" in page()
    assert f"The ninety recorded frames alone close {given}, so" in page()


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("planning", FIRST),
        ("planning_weighed", FIRST.with_name("simulator_weighed")),
        ("planning_grown", DRIVEN),
        ("planning_more", DRIVEN),
    ],
)
def test_the_committed_table_of_planners_follows_from_its_trials(name, model):
    place = RESULTS / name
    settings = from_settings(plan_actions.Settings, place / "settings.json", model)
    trials = plan_actions.read_trials(place / "trials.csv")
    assert {len(found) for found in trials.values()} == {settings.starts} and settings.starts >= 30
    assert plan_actions.markdown(plan_actions.summarise(trials)) == (place / "table.md").read_text()
