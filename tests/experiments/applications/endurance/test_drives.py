"""What a drive says happened is what the true simulator shows under its actions."""

from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.suite.simulator import SPECS, SuiteSimulator, suite_robot, suite_starts
from experiments.applications.endurance import drives
from experiments.applications.endurance.drives import HOLD_SECONDS, make_drive
from experiments.applications.scenes import point_names, points_of

ROBOT = suite_robot("gripper_wood", (-0.3, -0.3, -1.5, 0.0), (0.3, 0.3, 1.5, 1.0), (0.0,) * 4, 1)


@pytest.fixture(scope="module")
def start():
    return suite_starts("gripper_wood", 1, 3, stride=1)[0]


@pytest.mark.parametrize("kind", ["behaviour", "extremes", "alternation"])
def test_the_true_simulator_shows_the_same_frames(start, kind):
    drive = make_drive(ROBOT, start, 20, kind, seed=0)
    true = SuiteSimulator([ROBOT])
    seen = [true.reset([start])[0].copy()]
    for action in drive.actions:
        seen.append(true.step([action])[0].copy())
        assert not true.clipped[0]
    np.testing.assert_array_equal(drive.frames(0, 21), np.stack(seen))
    np.testing.assert_array_equal(drive.frames(7, 9), np.stack(seen[7:9]))


def test_robots_of_one_rate_draw_apart(start, monkeypatch):
    """Five robots of 4 Hz worked on their tasks, or did not, in the same twelve seconds."""
    drawn, behaviour = {}, drives.Behaviour
    monkeypatch.setattr(
        drives, "Behaviour", lambda world, rng: drawn.setdefault(world.spec.name, behaviour(world, rng))
    )
    for robot in (ROBOT, suite_robot("pusher_sand", (-8.0, -8.0), (8.0, 8.0), (0.0, 0.0), 1)):
        make_drive(robot, replace(start, robot=robot.name, actions=np.zeros((0, robot.action_dim))), 1, "behaviour", 0)
    first, second = (one.task_probability[0] for one in drawn.values())
    assert first != second


def test_a_drive_draws_its_behaviour_by_its_seed_and_anew_after_some_time(start, monkeypatch):
    began, behaviour = [], drives.Behaviour
    monkeypatch.setattr(drives, "RESTART_SECONDS", 5 / ROBOT.hz)
    monkeypatch.setattr(drives, "Behaviour", lambda *given: began.append(0) or behaviour(*given))
    first, again, other = (make_drive(ROBOT, start, 12, "behaviour", seed).actions for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any() and len(began) == 3 * 3


def test_actions_unlike_the_data(start):
    extremes = make_drive(ROBOT, start, 80, "extremes", seed=0).actions
    hold = round(HOLD_SECONDS * ROBOT.hz)
    assert (extremes[:hold, 0] == np.float32(0.3)).all() and (extremes[hold : 2 * hold, 0] == np.float32(-0.3)).all()
    assert set(np.flatnonzero((extremes != np.float32(ROBOT.rest)).any(0))) == {0, 1, 2, 3}
    jumps = np.diff(make_drive(ROBOT, start, 6, "alternation", seed=0).actions, axis=0)
    np.testing.assert_allclose(np.abs(jumps), np.tile([0.6, 0.6, 3.0, 1.0], (5, 1)), rtol=1e-5)


def test_an_object_is_the_point_of_its_colour(start):
    drive, spec = make_drive(ROBOT, start, 30, "behaviour", seed=1), SPECS["gripper_wood"]
    points, frames = drive.points(), drive.frames(0, 31).astype(float)
    names = point_names(spec)
    assert points.position.shape == (31, len(names), 2)
    assert (points.share[:, -3:] > 0).any(0).sum() == spec.task.objects  # the third colour is not there
    for c, name in enumerate(names[1:]):
        whole = points.share[:, 1 + c] == 1
        if not whole.any():
            continue
        t = int(np.flatnonzero(whole)[0])
        column, row = np.round(points.position[t, 1 + c] + [3, 3]).astype(int)  # beside the cap
        away = np.abs((frames[t, row, column] - 128) / 0.6 + 128 - np.array(spec.palette.objects)).mean(-1)
        assert away.argmin() == c, name


def test_a_missing_object_is_not_there():
    spec, q = SPECS["gripper_wood"], np.zeros((1, 4))
    points = points_of(spec, np.array([5]), q, np.full((1, 2, 2), 9.0))
    assert not points.visible[:, 1:].any() and points.visible[:, 0].all()
