"""Recordings in a physics simulator, whose physics is a stand-in here."""

import numpy as np
import pytest

from experiments.applications.judging.rollouts import make_starts, run
from experiments.applications.policies import find_task, record
from experiments.applications.policies.driving import new_episodes
from experiments.simulators import true_worlds
from hma_jax.config import ConfigError
from hma_jax.simulator.robots import Robot
from tests.data_pipelines.simulators.points import use_points

TASK = find_task("metaworld_drawer", frames=14)
HOW = {"stride": 5, "image_size": 8}


@pytest.fixture(autouse=True)
def points(monkeypatch):
    use_points(monkeypatch)


def test_the_expert_succeeds_and_play_does_not():
    expert, play = (record(TASK, 4, **HOW, noise=0.0, play=play) for play in (False, True))
    assert expert.successes.all() and not play.successes.any()
    np.testing.assert_array_equal(expert.actions[:, 0], 1.0)  # in play the hand has not moved at first, noise grows
    assert (np.diff(expert.images[:, :9, 0, 0, 0].astype(int), axis=1) > 0).all()
    again = record(TASK, 2, **HOW, noise=0.0)
    np.testing.assert_array_equal(again.images, expert.images[:2])
    noisy = record(TASK, 2, **HOW, noise=0.5)
    assert (noisy.actions != expert.actions[:2]).any() and np.abs(noisy.actions).max() <= 1
    short = record(TASK, 2, **HOW, noise=0.0, after=0)
    assert (short.lengths == expert.reached[:2].argmax(1) + TASK.hold).all()


def test_a_policy_is_run_from_starts_at_which_the_goal_is_not_reached():
    robot = Robot(TASK.robot, 5, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4)
    starts = make_starts(TASK, 2, 8, 5)
    assert len({s.seed for s in starts} - set(new_episodes(TASK, 99, 0, "demonstrations").tolist())) == 2

    class Ahead:
        def reset(self, episodes=None, *, seeds=None):
            pass

        def act(self, images):
            return np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]], np.float32)

    made = run(true_worlds([robot], episodes=2, image_size=8), Ahead(), starts, [0, 1], TASK)
    assert made.images.shape == (2, 15, 8, 8, 3) and made.reached.any(1).tolist() == [True, False]
    np.testing.assert_array_equal(made.images[:, 0], [s.images[-1] for s in starts])


def test_robots_of_the_suite_and_of_physics_simulators_have_no_common_truth():
    robots = [
        Robot(TASK.robot, 5, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4),
        Robot("pusher_sand", 1, (-1.0,) * 2, (1.0,) * 2, (0.0,) * 2),
    ]
    with pytest.raises(
        ConfigError,
        match="no single simulator has both robots of the suite and of physics simulators: metaworld_drawer, pusher_sand",
    ):
        true_worlds(robots, image_size=8)


def test_a_physics_simulator_knows_its_own_task_alone():
    assert TASK.goal == "drawer open"
    with pytest.raises(ConfigError, match="metaworld_drawer has no task 'reach'; it has own"):
        find_task("metaworld_drawer", "reach")
    with pytest.raises(ConfigError, match="robot 'metaworld_sawyer' has no task: a task needs a true simulator"):
        find_task("metaworld_sawyer")
