"""What is taken for a robot's range where a model's table alone is known, and what is done with values beyond it."""

import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.model.embodiments import Embodiment
from hma_jax.simulator.folder import load_robots, save_robots
from hma_jax.simulator.robots import Robot


def test_without_recorded_ends_the_range_is_three_deviations_and_what_never_moved_stays():
    robot = Robot.of(Embodiment("arm", 3, 2, (1.0, 0.5, 5.0), (0.5, 2.0, 0.0)))
    assert (robot.low, robot.high) == ((-0.5, -5.5, 5.0), (2.5, 6.5, 5.0))
    assert robot.rest == (0.0, 0.0, 5.0) and not robot.recorded and robot.stride == 2


def test_a_range_may_be_given_as_arrays(tmp_path):
    """Two such robots could not be compared, and none could be saved."""
    given, ends = Robot("arm", 1, np.float32([-1, 0]), [1, 0.5], np.zeros(2)), ((-1.0, 0.0), (1.0, 0.5), (0.0, 0.0))
    assert given == Robot("arm", 1, *ends) and hash(given) == hash(Robot("arm", 1, *ends))
    save_robots([given], tmp_path / "robots.json")
    assert load_robots(tmp_path / "robots.json") == (given,)


def test_an_action_to_begin_with_is_zero_or_the_mean_within_the_range():
    mean, low, high = (3.5, 1.0, 0.2, 9.0, 0.3), (2.0, 2.0, -1.0, 4.0, -1.0), (4.0, 3.0, 1.0, 5.0, 1.0)
    robot = Robot.of(Embodiment("arm", 5, 1, mean, (1.0, 1.0, 1.0, 1.0, 0.0), low=low, high=high))
    assert (robot.low, robot.high) == ((*low[:4], 0.3), (*high[:4], 0.3))  # the last one never moved
    assert robot.rest == (3.5, 2.0, 0.0, 5.0, 0.3)


def test_values_beyond_either_end_are_clipped_and_their_dimensions_named():
    robot = Robot.of(Embodiment("arm", 3, 2, (0.0,) * 3, (1.0,) * 3))
    clipped, beyond = robot.clip_to_range(np.array([[3.0, 4.0, 1.0], [-3.0, 0.0, -9.0]], np.float32), "clip")
    assert clipped.tolist() == [[3, 3, 1], [-3, 0, -3]] and beyond.tolist() == [False, True, True]
    with pytest.raises(ConfigError, match="action 1 of 0 to 4 is outside .*, -3 to 3; action 2 of -9 to 1 is"):
        robot.clip_to_range(np.array([[3.0, 4.0, 1.0], [-3.0, 0.0, -9.0]], np.float32), "refuse")
