"""Numbers that are drawn in a row, and keys that draw the same whatever JAX's own settings are."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import MaskingConfig
from hma_jax.evaluation.draws import random_actions, table_statistics, window_keys
from hma_jax.kernels.random import draw_flat, key_of
from hma_jax.objective.losses import draw_noise
from hma_jax.objective.masking import hide_actions, mask_batch
from tests.tiny import SMALLER, TABLE, model_config, random_batch


@pytest.mark.parametrize("shape", [(), (3,), (5, 1, 7, 3)])
def test_they_are_those_that_the_shape_itself_would_draw(shape):
    key = jax.random.key(7)
    np.testing.assert_array_equal(draw_flat(jax.random.uniform, key, shape), jax.random.uniform(key, shape))
    keys = jax.random.split(key, (2, 3))
    found = draw_flat(jax.random.uniform, keys, shape)
    assert found.shape == (2, 3, *shape)
    np.testing.assert_array_equal(found[1, 2], jax.random.uniform(keys[1, 2], shape))


@jax.jit
def draws() -> list[jax.Array]:
    """Of each kind that a seed decides: masks, hidden actions, noise of diffusion, actions at random."""
    config, key = model_config(**SMALLER), key_of(3)
    batch = random_batch(0, config)
    masked = mask_batch(key, batch["tokens"], batch["embodiment"], config, MaskingConfig("full"), TABLE)
    windows = window_keys(0, "actions", TABLE, batch["embodiment"], jnp.arange(8), jnp.arange(8))
    return [
        *masked,
        hide_actions(key, 64, MaskingConfig("policy")),
        *draw_noise(key, (64, 4), 1000),
        random_actions(windows, table_statistics(batch["embodiment"], TABLE), 2, 3),
    ]


@pytest.mark.parametrize(
    "setting",
    [partial(jax.enable_x64, True), partial(jax.default_prng_impl, "rbg"), partial(jax.threefry_partitionable, False)],
    ids=["x64", "rbg", "partitionable"],
)
def test_settings_of_jax_change_no_number_that_a_seed_decides(setting):
    usual = draws()
    with setting():
        elsewhere = draws()
    for mine, other in zip(usual, elsewhere, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_numbers_are_those_of_the_default_generator_of_jax():
    ours, theirs = key_of(3), jax.random.key(3, impl="threefry2x32")
    np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(theirs))
    for draw in (jax.random.bits, lambda key: jax.random.key_data(jax.random.split(jax.random.fold_in(key, 1)))):
        np.testing.assert_array_equal(draw(ours), draw(theirs))
