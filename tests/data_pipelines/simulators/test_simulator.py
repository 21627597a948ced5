"""Robots of physics simulators as true simulators. The physics is a stand-in: that of packages is in
test_simulators."""

import numpy as np
import pytest

from data_pipelines.simulators.simulator import PHYSICS, PhysicsSimulator, PhysicsWorld, new_seeds, physics_starts
from hma_jax.config import ConfigError
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start
from tests.data_pipelines.simulators.points import use_points

DRAWER = Robot("metaworld_drawer", 5, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4)
AHEAD, BACK = np.array([1.0, 0, 0, 0], np.float32), np.array([-1.0, 0, 0, 0], np.float32)


@pytest.fixture(autouse=True)
def points(monkeypatch):
    use_points(monkeypatch)


def starts(count: int = 2, seed: int = 0) -> list[Start]:
    return physics_starts(DRAWER.name, count, 3, stride=DRAWER.stride, image_size=8, seed=seed)


def test_an_episode_is_begun_again_where_its_start_ends():
    found, sim = starts(), PhysicsSimulator([DRAWER], episodes=2, image_size=8)
    assert [s.images.shape for s in found] == [(3, 8, 8, 3)] * 2 and found[0].actions.shape == (10, 4)
    np.testing.assert_array_equal(sim.reset(found), [s.images[-1] for s in found])
    for seed in (0, 2):
        assert [s.seed for s in starts(2, seed)] == new_seeds(DRAWER.name, 2, seed, "starts").tolist()
    assert [s.seed for s in starts(1)] == [found[0].seed]


def test_episodes_go_their_own_ways_wait_and_are_taken_back():
    sim = PhysicsSimulator([DRAWER], episodes=2, image_size=8)
    first = sim.reset(starts())
    seen = sim.step([AHEAD, None])
    np.testing.assert_array_equal(seen[1], first[1])
    assert seen[0, 0, 0, 0] == first[0, 0, 0, 0] + 10  # five native steps of 0.01, 200 shades each
    while not sim.success()[0]:
        sim.step([AHEAD, BACK])
    assert sim.success().tolist() == [True, False]
    np.testing.assert_array_equal(sim.rewind(sim.max_rewind(0) - 1, [0])[0], seen[0])
    assert not sim.success()[0]
    sim.step([np.full(4, 3.0), None])
    assert sim.clipped == [DRAWER.dimensions, ()]
    sim.close()
    with pytest.raises(ConfigError, match="episode 0 has not begun"):
        sim.step([AHEAD, None])


def test_a_world_that_gives_way_to_another_robot_is_closed():
    name, dim = next((name, spec.action_dim) for name, spec in PHYSICS.items() if name != DRAWER.name)
    sim = PhysicsSimulator([DRAWER, Robot(name, 5, (-1.0,) * dim, (1.0,) * dim, (0.0,) * dim)], image_size=8)
    (other,) = physics_starts(name, 1, 3, stride=5, image_size=8)
    opened = []
    for start in (*starts(1), other, *starts(1)):
        sim.reset(start)
        opened.append(sim._worlds[0][0].simulator)
    assert [one.size for one in opened] == [0, 0, 8]
    sim.close()
    assert opened[-1].size == 0


def test_a_world_that_cannot_begin_its_episode_is_closed_with_the_others(monkeypatch):
    (start,), sim, opened = starts(1), PhysicsSimulator([DRAWER], image_size=8), []

    def fails(world: PhysicsWorld, seed: int) -> None:
        opened.append(world.simulator)
        raise RuntimeError(f"no physics of {seed}")

    monkeypatch.setattr(PhysicsWorld, "reset", fails)
    with pytest.raises(RuntimeError, match="no physics"):
        sim.reset(start)
    sim.close()
    assert [one.size for one in opened] == [0]


def test_what_cannot_be_simulated_is_said():
    assert "metaworld_sawyer" not in PHYSICS  # fifty tasks: a seed does not say which
    with pytest.raises(ConfigError, match="robot 'metaworld_sawyer' has no true simulator"):
        PhysicsSimulator([Robot("metaworld_sawyer", 1, (0.0,), (1.0,), (0.0,))])
    with pytest.raises(ConfigError, match="4 action values in the true simulator, not 1"):
        PhysicsSimulator([Robot("metaworld_drawer", 1, (0.0,), (1.0,), (0.0,))])
    (start,) = starts(1)
    with pytest.raises(ConfigError, match="has no seed for the true simulator"):
        PhysicsSimulator([DRAWER], image_size=8).reset(Start(start.robot, start.images, start.actions))
