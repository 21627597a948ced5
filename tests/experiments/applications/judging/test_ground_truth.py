"""What of a judgement comes from the true simulator."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from experiments.applications.judging.ground_truth import describe_rare_success
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


def test_no_policy_starts_where_the_goal_is_reached_already():
    task, robot = find_task("gripper_mint"), Robot("gripper_mint", 5, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4)
    simulator = true_worlds([robot], image_size=8)
    (drawn,) = true_starts(robot, 1, 3, 8, seed=STARTS_SEED)
    (start,) = make_starts(task, 1, 8, robot.stride)
    simulator.reset(drawn)
    assert simulator.success().all(), "the first start would do, so nothing is tested"
    simulator.reset(start)
    assert not simulator.success().any()
