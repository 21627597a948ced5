"""The stepping interface: recorded episodes replay exactly, states can be kept and set again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.suite import EMBODIMENTS, Environment
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import CAP
from data_pipelines.suite.rollout import episode_seeds, simulate
from hma_jax.config import ConfigError

DELAYED = "picker_clay"


def stepped(env: Environment, actions: np.ndarray) -> list[np.ndarray]:
    frames = []
    for action in actions:
        env.step(action)
        frames.append(env.render())
    return frames


@pytest.mark.parametrize("name", ["pusher_sand", DELAYED, "humanoid_wood", "mobile_sky"])
def test_stepping_through_an_episode_gives_back_its_states_and_success(name):
    env = Environment(name)
    spec = replace(env.spec, seconds=(3.0, 4.0))
    rollout = simulate(spec, episode_seeds(spec, 5, 0))
    for i in (0, 3):
        env.reset(int(rollout.seeds[i]))
        reached = None
        for t in range(rollout.lengths[i]):
            np.testing.assert_array_equal(env.get_state().q[0], rollout.q[i, t])
            np.testing.assert_array_equal(env.get_state().objects[0], rollout.objects[i, t])
            env.step(rollout.actions[i, t])
            if env.success() and reached is None:
                reached = t
        assert (reached is not None) == rollout.success[i] and reached in (None, rollout.reached[i])


@pytest.mark.parametrize("name", [DELAYED, "gripper_wood", "rover_sky"])
def test_a_state_branches_into_other_futures_and_comes_back(name):
    env, rng = Environment(name), np.random.default_rng(0)
    recorded = simulate(env.spec, [7]).actions[0]
    env.reset(7)
    stepped(env, recorded[:10])
    state, shown = env.get_state(), env.render()
    first = stepped(env, recorded[10:16])
    env.set_state(state)
    np.testing.assert_array_equal(env.render(), shown)
    other = stepped(env, rng.permutation(recorded)[:6])
    assert any((a != b).any() for a, b in zip(first, other, strict=True))
    fresh = Environment(name)  # another environment goes on from it as well
    fresh.set_state(state)
    for a, b in zip(first, stepped(fresh, recorded[10:16]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_kept_state_does_not_change_when_the_environment_does():
    env = Environment(DELAYED)
    state = env.get_state()
    before = {name: value.copy() for name, value in vars(state).items()}
    stepped(env, simulate(env.spec, [3]).actions[0][:5])
    for name, value in vars(state).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("name", ["pusher_night", "rover_clay", "omni_night", "gripper_sky"])
def test_positions_are_where_things_are_in_the_frame(name):
    """The middle of an object has its cap's colour, wherever the camera stands."""
    env, found = Environment(name), 0
    for seed in range(80):
        env.reset(seed)
        at = env.positions()
        assert at.shape == (len(env.spec.points), 2) and at.dtype == np.float32
        tool = at[env.spec.points.index("tool_0")]
        thing = at[env.spec.points.index("object_0")]
        if not (4 < thing.min() and thing.max() < 59) or np.linalg.norm(tool - thing) < 26:
            continue
        frame, looks = env.render().astype(int), draw_appearance(env.spec, [seed])
        cap = looks.objects[0, 0, :3] * CAP + 128 * (1 - CAP)
        column, row = np.round(thing).astype(int)
        assert np.abs(frame[row, column] - cap).max() <= 2
        found += 1
    assert found >= 3


def test_an_environment_of_every_robot_steps_and_shows():
    for spec in EMBODIMENTS:
        env = Environment(spec)
        env.reset(1)
        assert env.render().shape == (64, 64, 3) and env.render().dtype == np.uint8
        env.step(np.zeros(spec.action_dim, np.float32))
        assert env.success() in (True, False)


def test_what_cannot_be_is_refused():
    with pytest.raises(ConfigError, match="unknown embodiment.*pusher_gold; the suite has .*pusher_sand"):
        Environment("pusher_gold")
    env = Environment("pusher_sand")
    with pytest.raises(ConfigError, match=r"pusher_sand: an action must have shape \(2,\), got \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ConfigError, match="the action is not finite"):
        env.step(np.array([0.0, np.nan]))
    with pytest.raises(ConfigError, match="the state is from another robot"):
        env.set_state(Environment("arm_chalk").get_state())
