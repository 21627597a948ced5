"""The suite's simulator and pictures: what a scaling study relies on, before any file."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.controls import Drive, JointRate, JointTarget
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.render import frame_index, render_frames
from data_pipelines.suite.rollout import simulate

BY_NAME = {spec.name: spec for spec in EMBODIMENTS}
every_embodiment = pytest.mark.parametrize("name", list(BY_NAME))


@cache
def rollout_of(name: str):
    return simulate(BY_NAME[name], 64, seed=5)


def test_the_table_is_as_heterogeneous_as_promised():
    assert len(EMBODIMENTS) == len(BY_NAME) == 40
    dims = [s.action_dim for s in EMBODIMENTS]
    assert (min(dims), max(dims)) == (2, 28)
    assert {s.hz for s in EMBODIMENTS} == {2, 3, 4, 5, 6, 8, 10, 15, 20, 30}
    assert {s.convention for s in EMBODIMENTS} == {"absolute", "delta", "velocity"}
    assert sum(s.dict_actions for s in EMBODIMENTS) >= 6
    assert sum(len(s.cameras) > 1 for s in EMBODIMENTS) >= 6
    sizes = [s.episodes for s in EMBODIMENTS]
    assert max(sizes) >= 20 * min(sizes)
    assert sum(s.episodes * s.hz * sum(s.seconds) / 2 for s in EMBODIMENTS) < 200_000


@pytest.mark.parametrize("count", [5, 10, 20])
def test_every_prefix_of_the_table_is_diverse(count):
    prefix = EMBODIMENTS[:count]
    assert len({s.kind for s in prefix}) >= 5
    assert {s.convention for s in prefix} == {"absolute", "delta", "velocity"}
    assert len({s.hz for s in prefix}) >= 5


@every_embodiment
def test_an_embodiment_simulates_soundly(name):
    spec, rollout = BY_NAME[name], rollout_of(name)
    assert rollout.actions.shape[2] == sum(dim for _, dim in spec.action_layout) == spec.action_dim
    for values in (rollout.q, rollout.objects, rollout.actions):
        assert np.isfinite(values).all()
    assert (rollout.q >= spec.body.low - 1e-9).all() and (rollout.q <= spec.body.high + 1e-9).all()
    assert (rollout.actions.std((0, 1)) > 1e-3).all(), "an action dimension carries no signal"
    stride = max(round(spec.hz / 2), 1)
    assert rollout.lengths.min() // stride >= 14, "the shortest episodes give no window of 12 frames"
    assert 0.05 < rollout.success.mean() < 0.95


@every_embodiment
def test_actions_decide_what_is_seen(name):
    """From the same start, one's own actions give the same frames, another's give others."""
    spec, n, steps = BY_NAME[name], 6, max(2 * BY_NAME[name].hz, 4)
    own = rollout_of(name)
    starts = simulate(spec, n, seed=9)
    again = simulate(spec, n, seed=9, actions=starts.actions[:, :steps])
    np.testing.assert_array_equal(again.q, starts.q[:, :steps])
    np.testing.assert_array_equal(again.objects, starts.objects[:, :steps])

    other = simulate(spec, n, seed=9, actions=own.actions[:n, :steps])
    looks = draw_appearance(spec, n, seed=9)
    last = np.full(n, steps - 1)
    frames = [render_frames(spec, r, looks, spec.cameras[0], np.arange(n), last) for r in (again, other)]
    assert frames[0].shape == (n, spec.cameras[0].height, spec.cameras[0].width, 3)
    changed = np.abs(frames[0].astype(int) - frames[1]).max(-1) > 15
    assert np.median(changed.mean((1, 2))) > 0.03, "other actions hardly change the picture"


def test_an_action_shows_only_after_its_own_observation():
    spec = BY_NAME["two_link_arm_joint_targets"]
    actions = simulate(spec, 4, seed=3).actions.copy()
    before = simulate(spec, 4, seed=3, actions=actions)
    actions[:, 7] += 1.0
    after = simulate(spec, 4, seed=3, actions=actions)
    np.testing.assert_array_equal(before.q[:, :8], after.q[:, :8])
    assert (np.abs(before.q[:, 8] - after.q[:, 8]).max(1) > 0.1).all()


def test_objects_move_only_when_they_are_pushed_but_distractors_by_themselves():
    spec = replace(BY_NAME["mirrored_pusher_targets"], look=BY_NAME["car_speed_and_steering"].look)
    start = simulate(spec, 8, seed=1)
    hold = np.repeat(start.q[:, :1], 40, 1) / spec.controls[0].unit  # absolute targets: stay where you are
    still = simulate(spec, 8, seed=1, actions=hold)
    assert np.abs(np.diff(still.objects, axis=1)).max() < 1e-6
    assert (np.linalg.norm(np.diff(still.distractors, axis=1), axis=-1) > 0.005).all()
    moved = np.linalg.norm(start.objects[:, -1] - start.objects[:, 0], axis=-1)
    assert (moved > 0.2).any(1).mean() > 0.5


def test_a_closed_gripper_carries_and_an_open_one_lets_go():
    spec = BY_NAME["gantry_gripper_normalised"]
    start = simulate(spec, 32, seed=2)
    q, thing = start.q[:, 0].copy(), start.objects[:, 0, 0]
    target = np.concatenate([np.clip(thing / 0.65, -1, 1), np.zeros((32, 1)), np.ones((32, 1))], 1)
    for _ in range(4):  # aim the fingers, not the head, at the object
        reach = np.column_stack([target[:, :2] * 0.65, q[:, 2] * 0, np.ones(32)])
        target[:, :2] += (thing - spec.body.tool_points(spec.body.pose(reach))[:, 0]) / 0.65
    near = (np.abs(target[:, :2]) <= 1).all(1)
    away = target * [-1, -1, 1, 0]
    plan = [target] * 30 + [target * [1, 1, 1, 0]] * 8 + [away] * 30 + [away + [0, 0, 0, 1]] * 8
    plan += [target] * 20
    end = simulate(spec, 32, seed=2, actions=np.stack(plan, 1))
    carried = np.linalg.norm(end.objects[:, 68, 0] - thing, axis=1)
    wanted = np.linalg.norm(away[:, :2] - target[:, :2], axis=1) * 0.65
    assert near.sum() >= 8
    assert (carried > 0.7 * wanted)[near & (wanted > 0.3)].mean() > 0.8
    assert np.abs(end.objects[near, -1, 0] - end.objects[near, 78, 0]).max() < 1e-6


@pytest.mark.parametrize("unit", [1.0, 1 / 32])
def test_units_change_the_numbers_but_not_the_motion(unit):
    spec = BY_NAME["disc_pusher_delta_pixels"]
    scaled = replace(spec, controls=(JointRate("xy", (0, 1), unit=unit, convention="delta"),))
    reference = replace(spec, controls=(JointRate("xy", (0, 1), unit=1.0, convention="velocity"),))
    a, b = simulate(scaled, 4, seed=0), simulate(reference, 4, seed=0)
    np.testing.assert_allclose(a.actions * unit * spec.hz, b.actions, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(a.q, b.q, atol=1e-4)


def test_wheels_turn_and_drive():
    body = BY_NAME["rover_wheel_speeds"].body
    drive = Drive("wheels", "wheels", track=0.4)
    q = np.zeros((2, 3))
    drive.advance(body, q, np.array([[0.5, 0.5], [-0.2, 0.2]]), h=0.5, dt=0.5)
    np.testing.assert_allclose(q, [[0.25, 0, 0], [0, 0, 0.5]], atol=1e-12)


def test_absolute_targets_are_reached_within_a_two_hertz_frame():
    body = BY_NAME["two_link_arm_joint_targets"].body
    control = JointTarget("joints", (0, 1))
    q, target = np.zeros((1, 2)), np.array([[0.8, -0.8]])
    for _ in range(15):
        control.advance(body, q, target, h=1 / 30, dt=1 / 30)
    np.testing.assert_allclose(q, target, atol=0.02)


def test_the_jacobian_is_the_derivative_of_the_tool_points():
    body = BY_NAME["mobile_pair_twist_and_targets"].body
    rng = np.random.default_rng(0)
    q = body.random(rng, 5)
    numeric = np.zeros((5, len(body.tools), 2, body.size))
    for c in range(body.size):
        step = np.eye(body.size)[c] * 1e-6
        high, low = (body.tool_points(body.pose(q + s)) for s in (step, -step))
        numeric[..., c] = (high - low) / 2e-6
    np.testing.assert_allclose(body.jacobian(body.pose(q)), numeric, atol=1e-6)


def test_episodes_differ_in_looks_and_shapes_lie_where_the_camera_says():
    spec = BY_NAME["disc_pusher_delta_pixels"]
    looks = draw_appearance(spec, 20, seed=0)
    assert looks.floor[:, 0].std(0)[:3].min() > 1.5
    rollout = simulate(spec, 1, seed=0)
    episode, step = frame_index(rollout, [0])
    camera = replace(spec.cameras[0], zoom=1.0, flip=True)
    frames = render_frames(spec, rollout, looks, camera, episode, step)
    x, y = rollout.q[0, : len(step)].T
    row, column = np.round(31.5 - 32 * y).astype(int), np.round(31.5 - 32 * x).astype(int)
    robot = looks.robot[0, 1, :3]
    assert np.abs(frames[np.arange(len(step)), row, column] - robot).max() <= 1


def test_the_suite_needs_neither_jax_nor_tensorflow():
    code = "import sys, data_pipelines.suite; print([m for m in ('jax', 'tensorflow') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
