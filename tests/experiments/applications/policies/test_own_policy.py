"""A world model that is post-trained to be a policy."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from data_pipelines.suite.world import World
from experiments.applications import own_policy
from experiments.applications.judging.user_policies import load_user_policies, try_out
from experiments.applications.own_policy import (
    OWN,
    RANDOM,
    Settings,
    compare,
    markdown,
    read_trials,
    summarise,
    windows,
    with_heads,
    write_results,
)
from experiments.applications.policies.cloning import BcConfig
from experiments.applications.policies.closed_loop import start_seeds
from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.network import EncoderConfig
from experiments.simulators import load_simulator
from hma_jax.config import ConfigError, DecodeConfig
from hma_jax.convert.run_directory import write_run
from hma_jax.model.hma import declare_model
from hma_jax.model.params import path_name
from hma_jax.training.optimizer import check_schedule
from hma_jax.training.runs import Run
from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import ROBOTS, parts

FEW = Settings(demonstrations=4, starts=3, steps=2, batch=2, frames=6)
SMALL = partial(BcConfig, encoder=EncoderConfig(8, (4, 4, 4), 8))


@pytest.mark.parametrize("name", ["steps", "starts"])
def test_what_nothing_can_come_of_is_refused_before_anything_is_claimed(name):
    with pytest.raises(ConfigError, match=f"--{name} must be at least 1, got 0"):
        replace(FEW, **{name: 0})


def test_windows_are_parts_of_episodes_with_the_actions_given_at_their_frames():
    model, robot = parts()[0], ROBOTS[1]  # two native steps per frame
    rng = np.random.default_rng(0)
    demos = Demonstrations(
        np.zeros((3, 6, 8, 8, 3), np.uint8), rng.normal(size=(3, 6, 7)).astype(np.float32), np.full(3, 6),
        np.zeros((3, 6), bool), np.ones(3, bool), np.arange(3),
    )  # fmt: skip
    tokens = np.broadcast_to(np.arange(6)[:, None], (3, 6, 4)) + 100 * np.arange(3)[:, None, None]
    make = windows(tokens, demos, model, robot, 2, seed=0)
    first, second = (batch for batch, _ in zip(make(0), range(2), strict=False))
    again = next(make(1))
    for name in first:
        np.testing.assert_array_equal(again[name], second[name])
    assert (first["embodiment"] == 1).all()
    for window, actions in zip(second["tokens"], second["actions"], strict=True):
        episode, at = window[0, 0] // 100, window[:, 0] % 100
        assert (np.diff(at) == 1).all()
        assert actions.shape == (model.config.frames, 14) and len(at) == model.config.frames
        for part in (actions[:, :7], actions[:, 7:]):
            np.testing.assert_array_equal(part, demos.actions[episode, at])
    ends = {
        int(window[-1, 0]) % 100 for batch, _ in zip(make(0), range(20), strict=False) for window in batch["tokens"]
    }
    assert ends == set(range(model.config.frames - 1, 6))


def test_heads_are_added_and_nothing_else_changes():
    model = parts()[0]
    config = replace(model.config, action_heads=False)
    params = declare_model(config, model.table).init(1)
    bare = replace(model, run=replace(model.run, model=config, params=params))
    known = {path_name(p): x for p, x in jax.tree_util.tree_leaves_with_path(bare.params)}
    params, config = with_heads(bare, 0)
    made = {path_name(p): x for p, x in jax.tree_util.tree_leaves_with_path(params)}
    assert config.action_heads and known.keys() < made.keys()
    for name, x in known.items():
        np.testing.assert_array_equal(made[name], x)


def test_what_is_post_trained_is_no_simulator_and_acts_in_one_by_the_file_of_the_page(tmp_path, monkeypatch):

    def trained(config, table, training, make, *, run_dir, initial, provenance, **_):
        check_schedule(training.optimizer, training.steps)  # also of few steps
        write_run(Run(config, training, table, initial, 0, provenance), run_dir)

    monkeypatch.setattr(own_policy, "train_model", trained)
    first = load_simulator(make_run(tmp_path / "study"))
    robot, images = first.robot(FEW.robot), np.zeros((2, 6, 8, 8, 3), np.uint8)
    none = np.zeros((2, 6), bool)
    demos = Demonstrations(images, np.zeros((2, 6, 2), np.float32), np.full(2, 6), none, none[:, 0], np.arange(2))
    run = tmp_path / "runs/own_policy/run"
    own_policy.post_train(first, robot, demos, FEW, run, lambda *_: None)
    with pytest.raises(ConfigError, match="'policy', which predicts no frames, so there are none to show"):
        load_simulator(run)
    page = (Path(__file__).parents[4] / "docs/policies.md").read_text()
    (tmp_path / "mine.py").write_text(page.split("```python\n")[1].split("```")[0])
    monkeypatch.chdir(tmp_path)
    users, _ = load_user_policies(tmp_path / "mine.py", robot)
    try_out(users, None, 2, (8, 8))
    assert list(users) == ["own_head"]


def test_outcomes_that_are_kept_do_not_depend_on_how_a_model_fills_frames(tmp_path, monkeypatch):
    model, tokenizer = parts()
    robot = replace(ROBOTS[0], name=FEW.robot)
    monkeypatch.setattr(own_policy, "BcConfig", SMALL)
    monkeypatch.setattr(own_policy, "POLICIES", (RANDOM,))
    monkeypatch.setattr(own_policy, "record", lambda *_, **__: None)
    for name in ("save_demonstrations", "load_demonstrations"):
        monkeypatch.setattr(own_policy, name, lambda *_: None)
    trials = []
    for temperature in (0.0, 1.0):
        decode = DecodeConfig(temperature=temperature)
        made = SimpleNamespace(
            model=model, tokenizer=tokenizer, decode=decode, robots={robot.name: robot}, robot=lambda _: robot
        )
        monkeypatch.setattr(own_policy, "load_simulator", lambda _, made=made: made)
        trials.append(compare(tmp_path / "run", tmp_path / "out", FEW))
    assert trials[0] == trials[1] and len(trials[0][RANDOM]) == FEW.starts
    assert compare(tmp_path / "run", tmp_path / "some", FEW, policies=(OWN,)) == {}  # of these there is none here
    assert compare(tmp_path / "run", tmp_path / "out", FEW, policies=(OWN,)) == trials[0]  # made before
    monkeypatch.undo()
    monkeypatch.setattr(own_policy, "load_simulator", lambda _: made)
    with pytest.raises(ConfigError, match="policies and success heads need images of 32 x 32 pixels, but 8 x 8"):
        compare(tmp_path / "run", tmp_path / "small", FEW)
    assert not (tmp_path / "small").exists()
    with pytest.raises(ConfigError, match="has a window of 4 frames, but an episode here has only 3"):
        compare(tmp_path / "run", tmp_path / "shorter", replace(FEW, frames=3, hold=1))


@pytest.mark.parametrize("name", ["own_policy", "own_policy_grown"])
def test_the_page_says_what_came(name):
    root = Path(__file__).parents[4]
    table = markdown(summarise(read_trials(root / "experiments/results" / name / "trials.csv")))
    assert table == (root / "experiments/results" / name / "table.md").read_text()
    assert table in (root / "docs/policies.md").read_text()


def test_the_page_says_what_predicting_the_clean_chunk_came_to():
    results, page = Path(__file__).parents[4] / "experiments/results", Path(__file__).parents[4] / "docs/policies.md"
    ((name, mean, low, high),) = summarise(read_trials(results / "own_policy_chunk/trials.csv"))
    made = json.loads((results / "own_policy_chunk/settings.json").read_text())
    noise = json.loads((results / "own_policy/settings.json").read_text())
    assert name == "Diffusion Policy" and made["predicts"] == "chunk" and made["seed"] == 0
    assert noise.items() <= made.items(), "all else is as in the table"
    assert f"succeeds from {mean:.2f} ({low:.2f} to {high:.2f}) of the same starts" in " ".join(
        page.read_text().split()
    )


def test_the_page_says_what_came_from_starts_that_do_not_begin_at_the_goal():
    root, task = Path(__file__).parents[4], Settings().make_task()
    away = ~World(task.spec, start_seeds(task, Settings.starts)).success()
    trials = read_trials(root / "experiments/results/own_policy/trials.csv")
    *first, last = (f"{np.mean([s for s, _ in np.array(found)[away]]):.2f}" for found in trials.values())
    page = " ".join((root / "docs/policies.md").read_text().split())
    assert f"for 4 frames; {(~away).sum()} starts have it there already" in page
    assert f"From the {away.sum()} starts that begin elsewhere success is {', '.join(first)} and {last}." in page


@pytest.mark.slow
def test_outcomes_are_made_once_and_written_with_intervals(tmp_path, monkeypatch):
    run, out = make_run(tmp_path / "study"), tmp_path / "out"
    monkeypatch.setattr(own_policy, "BcConfig", SMALL)
    monkeypatch.setattr(own_policy, "POLICIES", (OWN, RANDOM))
    trials = compare(run, out, FEW)
    assert list(trials) == [OWN, RANDOM] and {len(found) for found in trials.values()} == {FEW.starts}
    write_results(trials, out)
    assert read_trials(out / "trials.csv") == {
        name: [(s, round(d, 4)) for s, d in found] for name, found in trials.items()
    }
    monkeypatch.setattr(own_policy, "make_policy", lambda *_: pytest.fail("it was made again"))
    assert compare(run, out, FEW) == trials
    with pytest.raises(ConfigError, match="other settings .steps: 2 -> 3"):
        compare(run, out, replace(FEW, steps=3))
    done = summarise({"all": [(True, 0.0)] * 10, "none": [(False, 1.0)] * 10})
    assert [row[1] for row in done] == [1.0, 0.0] and done[0][2] > 0.6 and done[1][3] < 0.4
