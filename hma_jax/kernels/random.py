"""Random numbers that are quick to compile."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax

Sample = Callable[[jax.Array, tuple[int, ...]], jax.Array]
"""A function of `jax.random`: (key, shape) -> numbers."""


def draw_flat(sample: Sample, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """`sample(key, shape)`, the same numbers. `key` may be an array of keys, each with numbers of its own:
    [*key.shape, *shape].

    Drawn in a row and then given its shape: XLA's CPU compiler takes three to four times as long for three axes as for
    one.
    """
    numbers = jax.vmap(lambda one: sample(one, (math.prod(shape),)))(key.reshape(-1))
    return numbers.reshape(*key.shape, *shape)
