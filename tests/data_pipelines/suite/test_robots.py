"""Every robot simulated: its actions decide what is seen, its physics is sound."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.controls import Drive, JointRate
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.render import View, render_frames
from data_pipelines.suite.rollout import Rollout, episode_seeds, simulate
from data_pipelines.suite.spec import Camera, EmbodimentSpec, Physics
from data_pipelines.suite.world import EDGE, World

BY_NAME = {spec.name: spec for spec in EMBODIMENTS}
every_robot = pytest.mark.parametrize("name", list(BY_NAME))
FIRST = {spec.family: spec.name for spec in reversed(EMBODIMENTS)}.values()
"""One robot of each family."""


def short(spec: EmbodimentSpec) -> EmbodimentSpec:
    """The same robot in episodes of few seconds."""
    return replace(spec, seconds=(4.0, 6.0))


@cache
def rollout_of(name: str) -> Rollout:
    return simulate(short(BY_NAME[name]), episode_seeds(BY_NAME[name], 32, 5))


def frames_of(spec: EmbodimentSpec, rollout: Rollout, step: int) -> np.ndarray:
    n = len(rollout.q)
    looks = draw_appearance(spec, rollout.seeds)
    return render_frames(spec, looks, rollout.goals, rollout.q[:, step], rollout.objects[:, step], np.arange(n))


@every_robot
def test_a_robot_simulates_soundly(name):
    spec, rollout = BY_NAME[name], rollout_of(name)
    assert rollout.actions.shape[2] == spec.action_dim
    for values in (rollout.q, rollout.objects, rollout.actions):
        assert np.isfinite(values).all()
    assert (rollout.q >= spec.body.low - 1e-9).all() and (rollout.q <= spec.body.high + 1e-9).all()
    assert (np.abs(rollout.objects) <= EDGE - spec.task.size + 1e-9).all()
    spread = rollout.actions.std((0, 1))
    assert (spread > 1e-6).all(), "an action dimension carries no signal"
    moved = np.linalg.norm(rollout.objects[:, -1] - rollout.objects[:, 0], axis=-1)
    assert (moved > 0.1).any(1).mean() > 0.25, "objects are hardly ever touched"


@pytest.mark.parametrize("name", [n if n in FIRST else pytest.param(n, marks=pytest.mark.slow) for n in BY_NAME])
def test_actions_decide_what_is_seen(name):
    """From the same start, one's own actions give the same frames, another's give others."""
    spec, n, steps = short(BY_NAME[name]), 6, max(2 * BY_NAME[name].hz, 4)
    starts, own = simulate(spec, episode_seeds(spec, n, 9)), rollout_of(name)
    again = simulate(spec, starts.seeds, starts.actions[:, :steps])
    np.testing.assert_array_equal(again.q, starts.q[:, :steps])
    np.testing.assert_array_equal(again.objects, starts.objects[:, :steps])
    other = simulate(spec, starts.seeds, own.actions[:n, :steps])
    frames = [frames_of(spec, r, steps - 1) for r in (again, other)]
    changed = np.abs(frames[0].astype(int) - frames[1]).max(-1) > 15
    assert np.median(changed.mean((1, 2))) > 0.03, "other actions hardly change the picture"


def test_an_episode_of_few_given_actions_is_as_long_as_they_are_and_no_success():
    spec = BY_NAME["pusher_sand"]
    rollout = simulate(spec, episode_seeds(spec, 4, 0), np.zeros((4, 3, spec.action_dim), np.float32))
    assert rollout.lengths.tolist() == [3] * 4 and not rollout.success.any()


@every_robot
def test_the_background_is_still(name):
    """Where neither robot nor objects come, no pixel ever changes."""
    spec, rollout = BY_NAME[name], rollout_of(name)
    steps, episode = np.arange(0, rollout.lengths[0], 3), 0
    looks = draw_appearance(spec, rollout.seeds[:1])
    frames = render_frames(
        spec, looks, rollout.goals[:1], rollout.q[episode, steps], rollout.objects[episode, steps],
        np.zeros(len(steps), int),
    )  # fmt: skip
    still = (frames == frames[:1]).all((0, -1))
    assert still.mean() > 0.03


def test_episodes_succeed_and_fail_in_every_family():
    for family in {s.family for s in EMBODIMENTS}:
        success = np.concatenate([rollout_of(s.name).success for s in EMBODIMENTS if s.family == family])
        assert 0.02 < success.mean() < 0.98, family


def test_an_episode_depends_on_its_own_seed_alone():
    spec = BY_NAME["pusher_sand"]
    seeds = episode_seeds(spec, 8, 0)
    together, alone = World(spec, seeds).state, World(spec, seeds[5:6]).state
    for name, value in vars(alone).items():
        np.testing.assert_array_equal(value, getattr(together.take([5]), name), err_msg=name)
    for name, value in vars(draw_appearance(spec, seeds[5:6])).items():
        np.testing.assert_array_equal(value, getattr(draw_appearance(spec, seeds), name)[5:6], err_msg=name)


@pytest.mark.parametrize("delay", [0, 3])
def test_an_action_shows_after_its_observation_and_its_delay(delay):
    spec = replace(short(BY_NAME["gripper_wood"]), delay=delay)
    seeds = episode_seeds(spec, 4, 3)
    actions = simulate(spec, seeds).actions[:, :14].copy()
    before = simulate(spec, seeds, actions)
    actions[:, 7] += 0.3
    after = simulate(spec, seeds, actions)
    first = 8 + delay
    np.testing.assert_array_equal(before.q[:, :first], after.q[:, :first])
    assert (np.abs(before.q[:, first] - after.q[:, first]).max(1) > 0.02).all()


def push(spec: EmbodimentSpec, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """A head driven into a puck, then held still: the puck's place [T] and speed along x."""
    world = World(spec, [0])
    state = world.state
    state.q[:], state.objects[:] = [[-0.6, 0.0]], [[[0.0, 0.0], [0.0, 0.72]]]
    world.state = state
    places, unit = [], spec.controls[0].unit
    for t in range(round(seconds * spec.hz)):
        forward = 1.0 / spec.hz / unit if t < 0.4 * spec.hz else 0.0
        world.step(np.array([[forward, 0.0]]))
        places.append(world.objects[0, 0, 0])
    return np.array(places), np.diff(places) * spec.hz


def test_a_pushed_puck_glides_slows_down_and_stays_where_it_came_to_rest():
    spec = BY_NAME["pusher_wood"]
    places, speed = push(spec, 3.0)
    assert places[-1] > 0.1
    assert speed[round(0.6 * spec.hz)] > 0.05, "it stops with the head"
    np.testing.assert_array_equal(places[-5:], places[-1])
    further, _ = push(replace(spec, physics=Physics(inertia=0.06, friction=1.0, bounce=0.3)), 3.0)
    assert further[-1] > places[-1] + 0.05


def test_a_base_takes_a_moment_to_stop():
    spec = BY_NAME["omni_mint"]
    world = World(spec, [0])
    for _ in range(4):
        world.step(np.array([[0.5, 0.0, 0.0]]))
    before = world.q.copy()
    world.step(np.zeros((1, 3)))
    assert 0.02 < np.linalg.norm((world.q - before)[0, :2]) < 0.1  # inertia of 0.12 s at half a unit per second


def test_untouched_objects_do_not_move():
    spec = BY_NAME["pusher_sand"]
    world = World(spec, episode_seeds(spec, 16, 0))
    start = world.objects.copy()
    for _ in range(20):
        world.step(np.zeros((16, 2)))
    np.testing.assert_array_equal(world.objects, start)


def test_a_closed_gripper_carries_and_an_open_one_lets_go():
    spec = BY_NAME["gripper_wood"]
    world = World(spec, episode_seeds(spec, 8, 2))
    state = world.state
    state.q[:] = [0.3, 0.3, 0.0, 1.0]
    state.objects[:, 0] = world.body.tool_points(world.body.pose(state.q))[:, 0]
    state.objects[:, 1] = [-0.7, -0.7]
    world.state = state

    def go(x: float, y: float, grip: float, steps: int = 12) -> np.ndarray:
        for _ in range(steps):
            world.step(np.tile([x / 2.0, y / 2.0, 0.0, grip], (8, 1)))
        return world.objects[:, 0].copy()

    start = go(0.3, 0.3, 0.0)
    carried = go(-0.3, 0.0, 0.0)
    np.testing.assert_allclose(carried - start, np.tile([-0.6, -0.3], (8, 1)), atol=0.05)
    go(-0.3, 0.0, 1.0)
    left = go(0.3, 0.3, 1.0)
    assert np.linalg.norm(left - carried, axis=1).max() < 0.1


@pytest.mark.parametrize("unit", [1.0, 1 / 32])
def test_units_change_the_numbers_but_not_the_motion(unit):
    spec = short(BY_NAME["pusher_sand"])
    scaled = replace(spec, controls=(JointRate("xy", (0, 1), unit, "delta"),))
    reference = replace(spec, controls=(JointRate("xy", (0, 1), 1.0, "velocity"),))
    a, b = (simulate(s, episode_seeds(s, 4, 0)) for s in (scaled, reference))
    np.testing.assert_allclose(a.actions * unit * spec.hz, b.actions, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(a.q, b.q, atol=1e-4)


def test_wheels_turn_and_drive():
    body, drive = BY_NAME["rover_road"].body, Drive("wheels", "wheels", track=0.4)
    q = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]])
    rate = drive.rate(body, q, np.array([[0.5, 0.5], [0.5, 0.5], [-0.2, 0.2]]), dt=0.5)
    np.testing.assert_allclose(rate, [[0.5, 0, 0], [0, 0.5, 0], [0, 0, 1.0]], atol=1e-12)


@pytest.mark.parametrize("name", ["humanoid_sand", "picker_slate", "gripper_wood", "arm_chalk"])
def test_no_action_moves_a_joint_faster_than_it_can(name):
    spec = BY_NAME[name]
    world = World(spec, [1])
    for sign in (1.0, -1.0, 1.0):
        before = world.q.copy()
        world.step(np.full((1, spec.action_dim), sign * 1e6))
        assert (np.abs(world.q - before) <= 1.3 * spec.body.speed / spec.hz + 1e-9).all()


def test_the_jacobian_is_the_derivative_of_the_tool_points():
    body = BY_NAME["mobile_road"].body
    rng = np.random.default_rng(0)
    q = body.random(rng, 5)
    numeric = np.zeros((5, len(body.tools), 2, body.size))
    for c in range(body.size):
        step = np.eye(body.size)[c] * 1e-6
        high, low = (body.tool_points(body.pose(q + s)) for s in (step, -step))
        numeric[..., c] = (high - low) / 2e-6
    np.testing.assert_allclose(body.jacobian(body.pose(q)), numeric, atol=1e-6)


@pytest.mark.parametrize("camera", [Camera(), Camera(rotate=25, zoom=0.8, centre=(0.1, -0.2), tilt=0.7)])
def test_the_camera_goes_from_the_world_to_pixels_and_back(camera):
    view = View(camera)
    row, column = np.mgrid[:64, :64]
    np.testing.assert_allclose(view.points(view.world()), np.stack([column, row], -1), atol=1e-9)


def test_importing_the_suite_needs_neither_jax_nor_tensorflow():
    code = "import sys, data_pipelines.suite; sys.exit(any(m in sys.modules for m in ('jax', 'tensorflow', 'PIL')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
