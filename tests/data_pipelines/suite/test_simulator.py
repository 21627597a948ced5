"""The suite's true robots under the interface of the learned simulator."""

import numpy as np
import pytest

from data_pipelines import true_simulator
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.simulator import SuiteSimulator, suite_robot, suite_starts
from data_pipelines.true_simulator import judge_by_state
from hma_jax.config import ConfigError


def robot(name: str, dim: int, stride: int, most: float = 1.0):
    return suite_robot(name, (-most,) * dim, (most,) * dim, (0.0,) * dim, stride)


PUSHER, ARM = robot("pusher_sand", 2, 2), robot("arm_chalk", 3, 2)


@pytest.mark.parametrize("asked, stride", [(None, 2), (1, 1), (3, 3)])
def test_a_start_goes_on_as_its_own_actions_did(asked, stride):
    start = suite_starts("pusher_sand", 8, 4, stride=asked)[0]
    begun = SuiteSimulator([robot("pusher_sand", 2, stride, 1e9)])
    seen = begun.reset(type(start)(start.robot, start.images[:2], start.actions[:stride], start.seed))
    np.testing.assert_array_equal(seen[0], start.images[1])
    np.testing.assert_array_equal(begun.step([start.actions[stride : 2 * stride]])[0], start.images[2])


def test_starts_of_another_seed_are_of_other_episodes():
    first, other = ({start.seed for start in suite_starts("pusher_sand", 4, 2, seed=seed)} for seed in (0, 2))
    assert first and other and not first & other


def test_episodes_are_apart_clipped_and_taken_back(monkeypatch):
    sim = SuiteSimulator([PUSHER, ARM], episodes=2)
    starts = [suite_starts("pusher_sand", 8, 1)[0], suite_starts("arm_chalk", 8, 1)[0]]
    first = sim.reset(starts)
    assert not first.flags.writeable and not sim.images.flags.writeable, "as of a learned simulator"
    images = sim.step([np.array([5.0, 0.0]), None])
    assert sim.clipped == [("xy x",), ()] and (images[0] != first[0]).any()
    np.testing.assert_array_equal(images[1], first[1])
    true = Environment("pusher_sand")
    true.reset(starts[0].seed)
    for _ in range(2):
        true.step(np.array([1.0, 0.0]))
    np.testing.assert_array_equal(images[0], true.render())
    assert sim.max_rewind(0) == 1
    np.testing.assert_array_equal(sim.rewind(1, [0])[0], first[0])
    monkeypatch.setattr(true_simulator, "HISTORY", 2)
    seen = [sim.step([np.array([x, 0.0]), None])[0] for x in (0.9, 0.6, 0.3)]
    assert sim.max_rewind(0) == 2
    np.testing.assert_array_equal(sim.rewind(2, [0])[0], seen[0])


def test_frames_are_copied_once_however_many_episodes_there_are():
    """Once for each episode, a thousand of them copied 12 GB in every step."""
    sim, copies = SuiteSimulator([PUSHER], episodes=3), []

    class Frames(np.ndarray):
        def copy(self):
            copies.append(self)
            return super().copy()

    sim._images = sim._images.view(Frames)
    sim.reset(suite_starts("pusher_sand", 8, 1)[0])
    sim.step([np.array([0.9, 0.0])] * 3)
    sim.rewind(1)
    assert len(copies) == 3


def test_what_is_refused_changes_no_episode():
    sim, start = SuiteSimulator([PUSHER], episodes=2), suite_starts("pusher_sand", 8, 1)[0]
    unknown = type(start)(start.robot, start.images, start.actions)  # no seed
    sim.reset(start)
    now = sim.step([np.array([0.9, 0.0]), None])
    waiting = SuiteSimulator([PUSHER], episodes=2)
    waiting.reset(start, episodes=[0])
    for episodes in ([2], [-1], [0, 0]):
        for refused in (
            lambda which=episodes: sim.reset(start, episodes=which),
            lambda which=episodes: sim.rewind(0, which),
        ):
            with pytest.raises(ConfigError, match="episodes must be different numbers below 2"):
                refused()
    for b, reason in ((-1, "numbers below 2"), (5, "numbers below 2"), (0.5, "whole numbers"), (1, "has not begun")):
        for asked in (waiting.max_rewind, waiting.state):
            with pytest.raises(ConfigError, match=reason):
                asked(b)
    with pytest.raises(ConfigError, match=r"frames must be whole numbers, got \[0.5\]"):
        sim.rewind(0.5)
    with pytest.raises(ConfigError, match=r"episodes must be whole numbers, got \[1.5\]"):
        SuiteSimulator([PUSHER], episodes=1.5)
    with pytest.raises(ConfigError, match="a simulator needs at least 1 episode, got 0"):
        SuiteSimulator([PUSHER], episodes=0)
    with pytest.raises(ConfigError, match="has no seed for the true simulator"):
        sim.reset([start, unknown])
    for seeds, message in (
        ([1], "2 episodes need as many starts and seeds, got 2 and 1"),
        ("ab", "seeds must be whole numbers, got 'ab'"),
        ([-1, 0], "seeds must lie in .* got -1"),
    ):
        with pytest.raises(ConfigError, match=message):
            sim.reset(start, seeds=seeds)
    with pytest.raises(ConfigError, match="in episode 1 at most 0 frames can be rewound"):
        sim.rewind(1)
    np.testing.assert_array_equal(sim.images, now)
    assert sim.max_rewind(0) == 1


@pytest.mark.parametrize("stride", [1, 3])
def test_a_start_of_another_stride_is_refused(stride):
    """It began at another frame than the start's last."""
    [start] = suite_starts("pusher_sand", 8, 3, stride=stride, most=1)
    with pytest.raises(
        ConfigError, match=rf"with 3 frames needs 2 x 2 actions of 2 values .*, got \({2 * stride}, 2\)"
    ):
        SuiteSimulator([PUSHER]).reset(start)


def test_up_moves_the_pusher_up_and_right_to_the_right():
    for key, (column, row) in ((0, (1, 0)), (1, (0, -1))):
        true = Environment("pusher_sand")
        true.reset(suite_starts("pusher_sand", 8, 1)[0].seed)
        before = true.positions()[0]
        true.step(4 * np.array(PUSHER.keys[key], np.float32))
        assert np.sign(np.round(true.positions()[0] - before, 2)).tolist() == [column, row]


@pytest.mark.parametrize("name", ["rover_road", "arm_chalk", "gripper_wood", "humanoid_sand"])
def test_every_dimension_has_a_name_and_some_keys(name: str):
    dim = Environment(name).spec.action_dim
    described = robot(name, dim, 2)
    assert len(set(described.dimensions)) == dim and np.abs(described.keys).sum() >= 2
    assert described.keeps == (Environment(name).spec.convention == "absolute")


def test_the_judge_says_when_the_goal_is_reached():
    sim = SuiteSimulator([PUSHER], episodes=2)
    sim.reset(suite_starts("pusher_sand", 8, 1)[0], episodes=[0])
    world, _ = sim._worlds[0]
    state = world.get_state()
    assert judge_by_state(sim)[1].tolist() == [False, False]
    state.objects[0, 0] = state.goals[0, 0]
    world.set_state(state)
    rewards, done = judge_by_state(sim)
    assert rewards.tolist() == [1.0, 0.0] and done.tolist() == [True, False]


def test_what_the_suite_has_not_is_said():
    other = type(PUSHER)("walker", 1, (0.0,), (1.0,), (0.0,))
    with pytest.raises(ConfigError, match="robot 'walker' has no true simulator"):
        SuiteSimulator([other])
    with pytest.raises(ConfigError, match="2 action values in the true simulator, not 3"):
        SuiteSimulator([type(PUSHER)("pusher_sand", 2, (0.0,) * 3, (1.0,) * 3, (0.0,) * 3)])
    start = suite_starts("pusher_sand", 8, 1)[0]
    with pytest.raises(ConfigError, match="has no seed for the true simulator"):
        SuiteSimulator([PUSHER]).reset(type(start)(start.robot, start.images, start.actions))
