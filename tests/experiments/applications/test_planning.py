"""Planners: searches on functions whose least is known, models against what they model."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.suite.environment import Environment
from experiments.applications import plan_actions
from experiments.applications.plan_actions import (
    CLONED,
    PLANNERS,
    Settings,
    decided,
    draw,
    goal_image,
    summarise,
)
from experiments.applications.planning.cem import plan_cem
from experiments.applications.planning.control import ActionRange, Planner
from experiments.applications.planning.goals import block_means, goal_image_cost
from experiments.applications.planning.models import LearnedModel, TrueModel
from experiments.applications.planning.mppi import plan_mppi
from experiments.applications.planning.search import SearchConfig, repeat_knots, warm_start
from experiments.applications.planning.shooting import plan_shooting
from experiments.applications.policies.closed_loop import start_seeds
from experiments.applications.policies.tasks import find_task
from hma_jax.config import ConfigError, DecodeConfig
from hma_jax.simulator.folder import DECODE, save_decode
from hma_jax.simulator.robots import Robot
from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import ROBOTS, simulator

PAGE = Path(__file__).parents[3] / "docs/planning.md"
SEARCHES = list(dict.fromkeys(by for by, _ in PLANNERS.values()))
CONFIG = SearchConfig(candidates=16, iterations=4, knots=3, hold=2)
TARGET = np.array([[0.6, -0.5], [0.1, 0.4], [-0.7, 0.2]])
STRIDE_3 = Robot("pusher_sand", 3, (-8.8, -8.8), (8.8, 8.8), (0.0, 0.0))


def search(by, seed: int = 0, config: SearchConfig = CONFIG):
    """(distance of the plan from the least, candidates scored)."""
    batches = []

    def score(candidates: np.ndarray) -> np.ndarray:
        batches.append(candidates)
        return ((candidates - TARGET) ** 2).sum((1, 2))

    found = by(score, config, np.zeros_like(TARGET), np.random.default_rng(seed))
    assert [len(b) for b in batches] == [config.candidates] * config.iterations
    assert all(np.abs(b).max() <= 1 for b in batches)
    return float(((found - TARGET) ** 2).sum()), np.stack(batches)


@pytest.mark.parametrize("by", SEARCHES)
def test_every_search_of_the_command_scores_as_many_candidates_as_it_may_and_comes_nearer(by):
    """Of the same size in each batch, within the range; the same with the same random numbers."""
    reached = [search(by, seed)[0] for seed in range(8)]
    assert np.mean(reached) < 0.8 * (TARGET**2).sum()
    for one, again in zip(search(by, 3), search(by, 3), strict=True):
        np.testing.assert_array_equal(one, again)


def test_searches_that_learn_from_their_batches_beat_shooting():
    reached = {by: np.mean([search(by, seed)[0] for seed in range(8)]) for by in (plan_cem, plan_mppi, plan_shooting)}
    assert reached[plan_cem] < 0.5 * reached[plan_shooting]
    assert reached[plan_mppi] < 0.5 * reached[plan_shooting]


@pytest.mark.parametrize("by", [plan_cem, plan_mppi])
def test_each_batch_is_drawn_from_what_the_batch_before_says(by):
    """Where all candidates cost the same, the first ones are the elite, and all weigh the same."""
    rng, batches = np.random.default_rng(0), []
    found = by(lambda c: batches.append(c) or np.ones(len(c)), CONFIG, np.full((3, 2), 0.2), np.random.default_rng(0))
    first, second = (rng.standard_normal((16, 3, 2)) for _ in range(2))
    np.testing.assert_array_equal(batches[0], np.clip(np.concatenate([0 * first[:1], 0.7 * first[1:]]) + 0.2, -1, 1))
    if by is plan_cem:
        mean = 0.1 * 0.2 + 0.9 * batches[0][:4].mean(0)
        std = np.maximum(0.1 * 0.7 + 0.9 * batches[0][:4].std(0), 0.1)
        np.testing.assert_array_equal(batches[1][-1], batches[0][0])  # the best so far
        np.testing.assert_array_equal(found, batches[0][0])
    else:
        mean, std = batches[0].mean(0), 0.7 ** (2 / 3) * 0.1 ** (1 / 3)  # of four batches, from 0.7 to 0.1
        np.testing.assert_allclose(found, batches[-1].mean(0))
    np.testing.assert_allclose(batches[1][0], mean)
    np.testing.assert_allclose(batches[1][1:-1], np.clip(mean + std * second[1:-1], -1, 1))


def test_the_unit_of_costs_does_not_matter():
    plans = [
        plan_mppi(lambda c, by=by: by * c.sum((1, 2)), CONFIG, np.zeros((3, 2)), np.random.default_rng(0))
        for by in (1, 1000)
    ]
    np.testing.assert_allclose(*plans)


def test_mppi_weighs_candidates_by_their_costs_in_standard_deviations():
    """Each weighs exp(-cost / temperature), as in Williams et al. 2017."""
    config, batches = replace(CONFIG, iterations=1, temperature=0.3), []
    costs = np.random.default_rng(1).exponential(size=16)
    found = plan_mppi(lambda c: batches.append(c) or costs, config, np.zeros((3, 2)), np.random.default_rng(0))
    weights = np.exp(-costs / costs.std() / 0.3)
    np.testing.assert_allclose(found, np.einsum("b,bka->ka", weights / weights.sum(), batches[0]))


def test_starts_that_are_skipped_are_those_of_an_earlier_run():
    first, others = Settings(starts=2).start_seeds(), Settings(starts=2, skip=2).start_seeds()
    np.testing.assert_array_equal(np.concatenate([first, others]), Settings(starts=4).start_seeds())


@pytest.mark.parametrize("by", SEARCHES)
@pytest.mark.parametrize("shape", [(), (15,), (16, 1), (16, 6)])
def test_a_cost_that_is_not_one_number_for_each_candidate_is_no_plan(by, shape):
    """Where a cost lacked its axis, every plan was to rest."""
    with pytest.raises(ConfigError, match=re.escape(f"one number for each candidate, [16], got {list(shape)}")):
        by(lambda c: np.ones(shape), CONFIG, np.zeros((3, 2)), np.random.default_rng(0))


@pytest.mark.parametrize("by", SEARCHES)
def test_costs_may_be_a_list(by):
    plans = [
        by(lambda c, kind=kind: kind(c.sum((1, 2))), CONFIG, np.zeros((3, 2)), np.random.default_rng(0))
        for kind in (np.asarray, list)
    ]
    np.testing.assert_array_equal(*plans)


@pytest.mark.parametrize("by", SEARCHES)
def test_a_cost_that_is_not_finite_is_no_plan(by):
    with pytest.raises(ConfigError, match="not finite"):
        by(lambda c: np.full(len(c), np.nan), CONFIG, np.zeros((3, 2)), np.random.default_rng(0))


def test_the_next_search_begins_with_what_is_left_of_the_plan():
    plan = np.array([[1.0], [2.0], [3.0]])
    np.testing.assert_array_equal(warm_start(plan, CONFIG, 2), [[2.0], [3.0], [3.0]])
    np.testing.assert_array_equal(warm_start(plan, CONFIG, 6), [[3.0], [3.0], [3.0]])
    np.testing.assert_array_equal(warm_start(plan, CONFIG, 1), [[1.5], [2.5], [3.0]])  # of 1 2 2 3 3 3
    np.testing.assert_array_equal(warm_start(plan, CONFIG, 3), [[2.5], [3.0], [3.0]])
    np.testing.assert_array_equal(repeat_knots(plan, CONFIG)[:, 0], [1, 1, 2, 2, 3, 3])


def test_units_span_the_recorded_range():
    units = ActionRange.of(Robot("r", 1, (0.0, -3.0), (4.0, 1.0), (0.0, 0.0)))
    np.testing.assert_allclose(units.denormalise(np.array([[-1.0, -1.0], [1.0, 1.0]])), [[0.0, -3.0], [4.0, 1.0]])
    np.testing.assert_allclose(units.denormalise(units.rest), [0.0, 0.0])


def test_the_ends_of_the_units_are_within_the_range():
    """high - low is rounded: added to low, it came out above high, and was reported as clipped."""
    robot = Robot("r", 1, (-0.3, -0.4999987781047821), (0.7, 0.4999997615814209), (0.0, 0.0))
    ends = ActionRange.of(robot).denormalise(np.array([[-1.0, -1.0], [1.0, 1.0]]))
    for action in ends:
        robot.clip_to_range(action[None], "refuse")
    np.testing.assert_allclose(ends, [robot.low, robot.high], rtol=1e-6)


def test_every_plan_of_a_planner_has_its_own_numbers_and_a_warm_start():
    plan, began = np.array([[0.1], [0.2], [0.3]]), []

    def search(score, config, mean, rng):
        began.append((rng.random(), mean))
        return plan

    robot = Robot("r", 1, (-2.0,), (2.0,), (0.0,))
    one, again, other = (Planner(search, CONFIG, None, robot, None, seed) for seed in (1, 1, 2))
    actions = [planner.plan(2) for planner in (one, one, again, other)]
    np.testing.assert_allclose(actions, np.full((4, 2, 1), 0.2), rtol=1e-6)
    first, second, same, different = (number for number, _ in began)
    assert first == same and len({first, second, different}) == 3
    np.testing.assert_allclose(began[1][1], [[0.2], [0.3], [0.3]])
    for execute in (0, 7):
        with pytest.raises(ConfigError, match=f"execute must lie in 1..6, the frames of a plan, got {execute}"):
            one.plan(execute)


def test_a_goal_counts_in_the_second_half_of_the_horizon():
    goal, away = np.zeros((8, 32, 3), np.uint8), np.full((8, 32, 3), 255, np.uint8)
    assert block_means(away).shape == (8, 16, 3)
    cost = goal_image_cost(goal)(np.stack([[away, away, goal, goal], [goal, goal, away, goal]]))
    assert cost.tolist() == [0, 0.5]


@pytest.mark.parametrize("goal", [np.zeros((9, 9), np.uint8), np.zeros((8, 8, 3), np.float32)])
def test_what_is_no_image_of_a_goal_is_refused(goal):
    with pytest.raises(ConfigError, match=r"the image of a goal must be uint8 \[H, W, C\], got "):
        goal_image_cost(goal)


def test_a_goal_of_another_size_than_the_frames_is_refused():
    """The sizes 225 and 256 have no common cells: each frame was compared with the mean colour of the goal."""
    cost = goal_image_cost(np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(ConfigError, match="the image of the goal is 9 x 9 x 3, but the frames are 8 x 8 x 3"):
        cost(np.zeros((1, 2, 8, 8, 3), np.uint8))


@pytest.mark.parametrize("stride", [1, 2])
def test_the_true_model_sees_what_the_robot_would(stride):
    task = find_task("pusher_sand", "reach")
    robot, seen = Robot("pusher_sand", stride, (-8.0, -8.0), (8.0, 8.0), (0.0, 0.0)), Environment(task.spec)
    actions = np.random.default_rng(0).uniform(-8, 8, (2, 3, 2)).astype(np.float32)
    model = TrueModel(task.spec, robot, 64)
    seen.reset(5)
    began = seen.get_state()
    model.observe([], [], began)
    imagined = model.imagine(actions)
    for b in range(2):
        seen.set_state(began)
        for t in range(3):
            for _ in range(stride):
                seen.step(actions[b, t])
            np.testing.assert_array_equal(imagined[b, t], seen.render())


def test_a_planner_in_the_true_simulator_goes_where_the_picture_says():
    """The same picture distance as in the model; the head is brought from its start to where it was shown."""
    task = find_task("pusher_sand", "reach")
    robot, seen = Robot("pusher_sand", 1, (-8.8, -8.8), (8.8, 8.8), (0.0, 0.0)), Environment(task.spec)
    seen.reset(7)
    began = seen.get_state()
    for action in [(-8.0, 6.0)] * 5 + [(0.0, 0.0)] * 2:
        seen.step(np.array(action, np.float32))
    goal, there = seen.render(), seen.positions()[0]
    seen.set_state(began)
    model = TrueModel(task.spec, robot, 64)
    planner = Planner(plan_cem, SearchConfig(), model, robot, goal_image_cost(goal), seed=1)
    away = np.linalg.norm(seen.positions()[0] - there)
    for _ in range(4):
        model.observe([], [], seen.get_state())
        for action in planner.plan(2):
            seen.step(action)
    assert np.linalg.norm(seen.positions()[0] - there) < 0.2 * away


def test_the_learned_model_imagines_again_from_the_same_present():
    robot, rng = ROBOTS[0], np.random.default_rng(0)
    model = LearnedModel(simulator(episodes=2, history=1), robot)
    with pytest.raises(ConfigError, match="nothing was observed yet: call observe before imagine"):
        model.imagine(np.zeros((2, 1, robot.action_dim)))
    images = list(rng.integers(0, 256, (5, 8, 8, 3), np.uint8))
    given = list(rng.uniform(robot.low, robot.high, (4, robot.action_dim)).astype(np.float32))
    first, other = rng.uniform(robot.low, robot.high, (2, 2, 3, robot.action_dim)).astype(np.float32)
    first[1] = first[0]
    model.observe(images, given, None)
    imagined = model.imagine(first)
    np.testing.assert_array_equal(imagined[0], imagined[1])  # candidates share their seed
    assert (model.imagine(other) != imagined).any()
    np.testing.assert_array_equal(model.imagine(first), imagined)
    assert (goal_image_cost(imagined[0, -1])(imagined) < goal_image_cost(255 - imagined[0, -1])(imagined)).all()


def test_native_actions_are_no_frames_of_a_plan():
    """A candidate's actions became native ones: of a stride of 3, every third was a frame."""
    with pytest.raises(ConfigError, match="planning needs a simulator of rate='model', .* not native actions"):
        LearnedModel(simulator(episodes=2, rate="native"), ROBOTS[0])


class Recorder:
    """A simulator of two episodes that keeps what it was reset to, and shows black images."""

    def __init__(self, temperature: float = 0.7, channels: int = 0):
        self.decode, self.asked = DecodeConfig(temperature=temperature), []
        self.tokenizer = SimpleNamespace(channels=channels, image_size=32)

    def __len__(self) -> int:
        return 2

    def reset(self, start, seeds):
        self.start = start
        self.asked.append(seeds)

    def snapshot(self):
        return "its state"

    def restore(self, snapshot):
        pass

    def step(self, actions):
        return np.zeros((len(actions), 32, 32, 3), np.uint8)


def test_the_learned_model_begins_with_the_newest_frames_and_the_actions_between_them():
    recorder, robot = Recorder(), Robot("r", 2, (-9.0,), (9.0,), (0.0,))
    images, actions = list(np.arange(5, dtype=np.uint8)[:, None, None, None]), [np.array([float(i)]) for i in range(4)]
    LearnedModel(recorder, robot).observe(images, actions, None)
    assert recorder.start.images.ravel().tolist() == [2, 3, 4]
    assert recorder.start.actions.ravel().tolist() == [2, 2, 3, 3]
    LearnedModel(recorder, robot).observe(images[:1], [], None)
    assert recorder.start.images.ravel().tolist() == [0] and recorder.start.actions.shape == (0, 1)
    for count in (3, 5):  # the last ones would be taken for those between the last images
        with pytest.raises(ConfigError, match=f"5 images with {count} actions between them: .*one fewer than images"):
            LearnedModel(recorder, robot).observe(images, [np.zeros(1)] * count, None)


def test_observed_actions_outside_the_range_are_said_once(caplog):
    model, images = (
        LearnedModel(Recorder(), Robot("r", 1, (-9.0,), (9.0,), (0.0,))),
        list(np.zeros((2, 1, 1, 3), np.uint8)),
    )
    model.observe(images, [np.array([9.0])], None)
    assert not caplog.text
    for _ in range(2):
        model.observe(images, [np.array([99.0])], None)
    assert caplog.text.count("r: observed action 0 of 99 to 99 is outside the range") == 1


@pytest.mark.parametrize(("temperature", "channels"), [(0.7, 0), (0.0, 0), (0.7, 4), (0.0, 4)])
def test_every_search_and_every_start_samples_with_its_own_numbers(temperature, channels):
    """A greedy model is one function of frames and actions, the order of unmasking included."""
    simulator, robot = Recorder(temperature, channels), Robot("pusher_sand", 1, (-8.8, -8.8), (8.8, 8.8), (0.0, 0.0))
    settings = Settings(frames=11, hold=6, search=SearchConfig(candidates=4, iterations=1))
    for seed in start_seeds(settings.make_task(), 2).tolist():
        plan_actions.run_planner("MPPI in the model", simulator, robot, settings, seed)
    shared = [seeds[0] for seeds in simulator.asked]
    assert [seeds == seeds[:1] * 2 for seeds in simulator.asked] == [True] * len(shared) and len(shared) >= 4
    assert len(set(shared)) == (len(shared) if temperature else 2)


def test_an_action_is_carried_out_for_as_many_native_steps_as_a_frame_has(monkeypatch):
    steps: list[list[float]] = []

    class Watched(Environment):
        def step(self, action):
            steps.append(action.tolist())
            super().step(action)

    monkeypatch.setattr(plan_actions, "Environment", Watched)
    settings = Settings(frames=7, hold=6, search=SearchConfig(candidates=4, iterations=1))  # decided after one frame
    plan_actions.run_planner("MPPI in the model", Recorder(), STRIDE_3, settings, int(settings.start_seeds()[0]))
    assert len(steps) == 3 and steps == steps[:1] * 3


def test_a_cloned_policy_learns_and_acts_at_the_rate_of_the_model(monkeypatch):
    asked, none = {}, SimpleNamespace(success=[], distance=[])
    monkeypatch.setattr(plan_actions, "record", lambda task, count, **how: asked.update(how))
    monkeypatch.setattr(plan_actions, "clone", lambda *_: "policy")
    monkeypatch.setattr(plan_actions, "run_policy", lambda *given: asked.update(ran=given) or none)
    plan_actions.run_cloned(Settings(), STRIDE_3, np.arange(2), 32, next(iter(CLONED)), lambda *_: None)
    assert asked["stride"] == 3 and asked["image_size"] == 32 and asked["ran"][3:] == (32, 3)


def test_the_picture_of_the_goal_is_of_an_expert_that_had_the_time_of_two_episodes():
    """Of a model with four actions per frame, whose episodes are four times as long, it was taken on the way."""
    [seed] = start_seeds(find_task("pusher_sand", "reach"), 1).tolist()
    of = lambda frames, stride: goal_image(find_task("pusher_sand", "reach", frames), seed, 32, stride)  # noqa: E731
    np.testing.assert_array_equal(of(4, 4), of(16, 1))
    assert (of(4, 1) != of(16, 1)).any()


@pytest.mark.slow
def test_the_program_of_the_page_plans(tmp_path, monkeypatch):
    (text,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    make_run(tmp_path / "runs/mine")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(text.replace("my_robot", "pusher_sand"), names)
    low, high = names["robot"].low, names["robot"].high
    assert names["plan"].shape == (2, 2) and (names["plan"] >= low).all() and (names["plan"] <= high).all()


def test_a_figure_shows_planners_that_always_or_never_succeed(tmp_path):
    episode = {"distance": 0.1, "seconds": 1.0}
    tried = {
        "MPPI in the model": [episode | {"success": True}] * 50,
        "random actions": [episode | {"success": False}] * 5,
    }
    draw(summarise(tried), tmp_path / "planning.png")
    assert (tmp_path / "planning.png").exists()


def test_ways_that_were_tried_before_stay_in_the_table(tmp_path, monkeypatch):
    run, out = make_run(tmp_path / "study"), tmp_path / "out"

    def run_cloned(settings, *_):
        return [{"success": True, "distance": 0.0, "seconds": 0.0}] * settings.starts

    monkeypatch.setattr(plan_actions, "run_cloned", run_cloned)
    monkeypatch.setattr(plan_actions, "run_planner", lambda *_: {"success": False, "distance": 1.0, "seconds": 1.0})
    tried = "random actions", "MPPI in the model", "behaviour cloning of 100 trajectories"
    for way in tried:
        monkeypatch.setattr(sys, "argv", ["plan_actions", str(run), "--starts", "2", "--out", str(out), "--ways", way])
        plan_actions.main()
    assert set(plan_actions.read_trials(out / "trials.csv")) == set(tried)


def test_models_are_planned_in_at_one_temperature_whatever_their_own(tmp_path, monkeypatch):
    """One sampled and one greedy model stood in one table, and nothing said so."""
    monkeypatch.setattr(plan_actions, "run_cloned", lambda *_: [{"success": True, "distance": 0.0, "seconds": 0.0}])
    found = []
    for name, own, asked in (("a", 0.7, []), ("b", 0.0, []), ("c", 0.0, ["--temperature", "0.5"])):
        run, out = make_run(tmp_path / name), tmp_path / name / "out"
        save_decode(DecodeConfig(8, own), run / DECODE)
        ways = ["--starts", "1", "--ways", "random actions"]
        monkeypatch.setattr(sys, "argv", ["plan_actions", str(run), "--out", str(out), *ways, *asked])
        plan_actions.main()
        said = json.loads((out / "settings.json").read_text())
        found.append((said["temperature"], said["simulator"]["decode"]["temperature"]))
    assert found == [(0, 0), (0, 0), (0.5, 0.5)]


def test_an_episode_ends_when_nothing_can_change_its_outcome():
    task = find_task("pusher_sand", "reach", frames=16, hold=6)
    assert decided([False] * 4 + [True] * 6, task) and not decided([False] * 4 + [True] * 5, task)
    assert decided([False] * 11, task) and not decided([False] * 10, task)
    assert not decided([False] * 10 + [True] * 5, task) and decided([False] * 10 + [True, False], task)


def test_a_plan_is_not_carried_out_for_longer_than_it_is_nor_searched_among_too_few(monkeypatch):
    assert Settings(execute=6).search.frames == 6
    with pytest.raises(ConfigError, match="--execute must lie in 1..6, the frames of a plan, got 7"):
        Settings(execute=7)
    with pytest.raises(ConfigError, match="--frames must be more than the 6 in a row at the goal .*; got 6"):
        Settings(frames=6)  # nothing was planned, and the seconds of a plan were no number
    assert not decided([False], Settings(frames=7).make_task())
    monkeypatch.setattr(sys, "argv", ["plan_actions", "nowhere", "--candidates", "2"])
    with pytest.raises(ConfigError, match="--candidates must be at least 4, got 2"):
        plan_actions.main()
