"""Points from heat, and the loss that asks for it."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.applications.detector_network import detect, init_detector, locate_peaks, points_loss, target_heat


def logits(heat: jax.Array) -> jax.Array:
    heat = jnp.clip(heat, 1e-6, 1 - 1e-6)
    return jnp.log(heat) - jnp.log1p(-heat)


def fresh(robots: int, points: int):
    return jax.jit(lambda: init_detector(jax.random.key(0), robots=robots, points=points))()


def test_a_point_is_found_where_its_heat_is_and_is_sure_only_if_it_is_there():
    position = jnp.array([[[10.0, 40.5], [31.3, 7.2]], [[55.0, 20.0], [3.0, 62.0]]])
    there = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    found = jax.jit(lambda: locate_peaks(logits(target_heat(position, there, 32))))()
    np.testing.assert_allclose(found.position[there > 0], position[there > 0], atol=0.2)
    assert (np.asarray(found.confidence[there > 0]) > 0.75).all() and found.confidence[1, 1] < 1e-3


def test_robots_have_outputs_of_their_own():
    weights = fresh(robots=2, points=3)
    film = np.random.default_rng(1).uniform(0, 255, (5, 16, 16, 3)).astype(np.float32)
    run = jax.jit(detect)
    found, other = run(weights, film, 0), run(weights, film, 1)
    assert found.position.shape == (5, 3, 2) and (other.confidence != found.confidence).any()
    moved = weights | {"heads": np.asarray(weights["heads"]) + np.array([0, 1], np.float32).reshape(2, 1, 1)}
    np.testing.assert_array_equal(run(moved, film, 0).confidence, found.confidence)


def test_the_loss_is_least_where_the_heat_is_right_and_asks_of_known_points_alone():
    weights = fresh(robots=1, points=2)
    images, robot = np.zeros((1, 16, 16, 3), np.float32), np.zeros(1, np.int32)
    position, there = np.full((1, 2, 2), 6.5, np.float32), np.array([[1.0, 0.0]], np.float32)

    @jax.jit
    def loss(bias: float, known: jax.Array) -> jax.Array:
        blind = weights | {"heads": 0 * weights["heads"], "heads_bias": jnp.array([[-2.0, bias]])}
        return points_loss(blind, images, robot, position, there, known)

    both, first = np.ones((1, 2), np.float32), np.array([[1.0, 0.0]], np.float32)
    assert loss(-9.0, both) < loss(-2.0, both) and loss(-9.0, first) == loss(-2.0, first) > 0
