"""What of a judgement comes from the true simulator."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from experiments.applications.judging import ground_truth
from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.ground_truth import SimulatedTruth, describe_rare_success
from experiments.applications.judging.rollouts import STARTS_SEED, make_starts
from experiments.applications.policies.tasks import find_task
from experiments.simulators import true_starts, true_worlds
from hma_jax.simulator.robots import Robot


def test_an_expert_that_hardly_does_its_own_task_is_told():
    seldom, often = (SimpleNamespace(successes=np.arange(10) < n) for n in (2, 6))
    task = replace(find_task("pusher_sand"), frames=12)
    told = "The scripted expert of pusher_sand succeeds in only 20% of the demonstrations (12 frames each), so"
    assert describe_rare_success(seldom, task).startswith(told) and describe_rare_success(often, task) == ""
    assert describe_rare_success(seldom, find_task("pusher_sand", "reach")) == ""


def test_the_head_is_measured_on_other_episodes_than_it_learns_from_and_all_are_at_the_rate_of_the_model(monkeypatch):
    asked: list[dict] = []
    made = SimpleNamespace(successes=np.ones(1))
    monkeypatch.setattr(ground_truth, "record", lambda task, count, **how: asked.append(how) or made)
    monkeypatch.setattr(ground_truth, "join", lambda parts: parts)
    monkeypatch.setattr(ground_truth, "train_head", lambda *_: None)
    monkeypatch.setattr(ground_truth, "measure_head", lambda *_: {})
    robot = Robot("gripper_wood", 3, (0.0,) * 4, (1.0,) * 4, (0.0,) * 4)
    learned = SimpleNamespace(tokenizer=SimpleNamespace(image_size=32))
    truth = SimulatedTruth(JudgeConfig(find_task("gripper_wood")), robot, learned)
    truth.make_head(None)
    trained = {how["seed"] for how in asked}
    truth.measure(None, None)
    measured = {how["seed"] for how in asked} - trained
    truth.demonstrations()
    assert len(trained) == len(measured) == 2  # of experts, and of play
    assert {(how["stride"], how["image_size"]) for how in asked} == {(3, 32)}


def test_no_policy_starts_where_the_goal_is_reached_already():
    task, robot = find_task("gripper_mint"), Robot("gripper_mint", 5, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4)
    simulator = true_worlds([robot], image_size=8)
    (drawn,) = true_starts(robot, 1, 3, 8, seed=STARTS_SEED)
    (start,) = make_starts(task, 1, 8, robot.stride)
    simulator.reset(drawn)
    assert simulator.success().all(), "the first start would do, so nothing is tested"
    simulator.reset(start)
    assert not simulator.success().any()
