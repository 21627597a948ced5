"""Random numbers belong to a window, whoever else is there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.evaluation.draws import random_actions, table_statistics, window_keys
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from tests.tiny import TABLE

BASE = TABLE.index("base")


def draw(table, robot, episodes, draws=3, frames=6, seed=0):
    def inside(episode):
        robots = jnp.full(len(episode), robot)
        keys = window_keys(seed, "actions", table, robots, episode, jnp.zeros_like(episode))
        return random_actions(keys, table_statistics(robots, table), draws, frames)

    return np.asarray(jax.jit(inside)(jnp.asarray(episodes)))


def test_random_actions_follow_the_robot_s_statistics():
    draws = draw(TABLE, BASE, range(400))
    assert draws.shape == (400, 3, 6, TABLE.action_width)
    np.testing.assert_allclose(draws[..., :3].std((0, 1, 2)), [1.0, 0.0, 3.0], rtol=0.05)
    assert (draws[..., 9:] == 0).all()
    arm = TABLE.index("arm")
    np.testing.assert_allclose(draw(TABLE, arm, range(200))[..., :14].mean((0, 1, 2)), 0.5, atol=0.01)
    values = draws[..., [0, 2, 3, 5, 6, 8]] / [1, 3, 1, 3, 1, 3]  # the live ones, by their own deviation
    together = np.corrcoef(values.reshape(400, -1), rowvar=False)
    assert np.abs(together - np.eye(len(together))).max() < 0.3


@pytest.mark.exact
@pytest.mark.parametrize("width", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 15)), 300])
def test_random_actions_depend_on_neither_the_table_nor_the_batch(width):
    want = draw(TABLE, BASE, range(8))
    newcomer = Embodiment("newcomer", width, 1, (0.0,) * width, (1.0,) * width)
    for entries in ((*TABLE.entries, newcomer), (newcomer, TABLE.entries[BASE])):
        table = EmbodimentTable(entries)
        own = min(table.action_width, TABLE.action_width)
        got = draw(table, table.index("base"), range(8))
        np.testing.assert_array_equal(got[..., :own], want[..., :own])
        assert (got[..., TABLE.entries[BASE].chunk :] == 0).all()
    np.testing.assert_array_equal(draw(TABLE, BASE, [5]), want[5:6])


def test_windows_robots_seeds_and_purposes_have_keys_of_their_own():
    one = jnp.zeros(1, jnp.int32)
    keys = [
        window_keys(seed, purpose, TABLE, one + robot, one + episode, one + start)
        for seed in (0, 1)
        for purpose in ("actions", "decoding", "likelihood", "policy")
        for robot in (0, 1)
        for episode in (0, 1, 12)
        for start in (0, 1, 12)
    ]
    assert len({jax.random.key_data(k).tobytes() for k in keys}) == 2 * 4 * 2 * 3 * 3


@pytest.mark.parametrize(
    ("purpose", "numbers"),
    [
        ("actions", [2954442257, 1268906379]),
        ("decoding", [1570006489, 2543685168]),
        ("likelihood", [602858163, 1351430469]),
        ("policy", [3589570117, 2835087674]),
    ],
)
def test_the_keys_of_a_window_are_those_of_every_version(purpose, numbers):
    """Results that different ones made are compared."""
    (key,) = window_keys(3, purpose, TABLE, *jnp.array([[1], [7], [12]]))
    assert jax.random.key_data(key).tolist() == numbers
