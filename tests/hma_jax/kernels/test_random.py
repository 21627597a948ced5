"""Numbers that are drawn in a row."""

import jax
import numpy as np
import pytest

from hma_jax.kernels.random import draw_flat


@pytest.mark.parametrize("shape", [(), (3,), (5, 1, 7, 3)])
def test_they_are_those_that_the_shape_itself_would_draw(shape):
    key = jax.random.key(7)
    np.testing.assert_array_equal(draw_flat(jax.random.bits, key, shape), jax.random.bits(key, shape))
    keys = jax.random.split(key, (2, 3))
    found = draw_flat(jax.random.bits, keys, shape)
    assert found.shape == (2, 3, *shape)
    np.testing.assert_array_equal(found[1, 2], jax.random.bits(keys[1, 2], shape))
