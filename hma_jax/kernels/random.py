"""Random numbers that are quick to compile, and the same whatever JAX's own settings are.

A run's random numbers must be a function of its seed. The library therefore makes its keys with `key_of`, and names the
type of the numbers in every draw: with JAX's default types, other numbers are drawn under JAX_ENABLE_X64.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import random as generators


def _partitionable(draw: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """`draw` with partitionable threefry, JAX's default, whatever JAX_THREEFRY_PARTITIONABLE says."""

    @functools.wraps(draw)
    def drawn(*args: Any) -> jax.Array:
        with jax.threefry_partitionable(True):
            return draw(*args)

    return drawn


_THREEFRY = generators.threefry_prng_impl

GENERATOR = generators.define_prng_impl(
    key_shape=_THREEFRY.key_shape,
    seed=_THREEFRY.seed,
    split=_partitionable(_THREEFRY.split),
    random_bits=_partitionable(_THREEFRY.random_bits),
    fold_in=_THREEFRY.fold_in,
    name="hma_threefry2x32",
    tag="hma",
)
"""JAX's default generator, also where JAX_DEFAULT_PRNG_IMPL names another one: with others, numbers depend on batches
and devices."""


class Tag:
    """The tags that `fold_in` takes to branch a stream of random numbers off a key. Results depend on their values.

    Streams of one key need different tags. `jax.random.split(key, n)[i]` is `fold_in(key, i)` with this generator, so a
    split takes the tags 0 .. n - 1. `->` is one `fold_in`:

        seed's key -> training step      the key of a step (validation: its seed's key -> batch)
        step -> row                      masks and corruption of an example
                    -> HIDDEN_ACTIONS    which of its actions are hidden
        step -> NOISE -> row             the noise key of an example
                    -> 0, 1, 2           models on ids: `objective.own_past`, by a split
                    -> 0 .. repeats - 1  models on latents: each noised copy of the tokens
                    -> ACTION_NOISE      models on latents: noise of its actions
                    -> DISPLACED_PAST    `objective.displaced`

        key of a rollout -> frame t      one frame that is decoded
                    -> 0 .. M - 1        its unmasking steps
                    -> M                 models on latents: the order of its patches
        key of a policy -> PER_FRAME * t + u
                                         models on latents: value u of the chunk of frame t
        key of a sampler -> step         noise of each step of the process; the initial noise has the tag after the last

    The streams of an evaluation are in `evaluation.draws`.
    """

    HIDDEN_ACTIONS = 1
    NOISE = 2**31 - 1  # beyond every row
    ACTION_NOISE = 2**20  # beyond every repeat
    DISPLACED_PAST = 2**31 - 1  # beyond every repeat and the split of `own_past`
    PER_FRAME = 2**16  # beyond every value of a chunk


Sample = Callable[[jax.Array, tuple[int, ...], jnp.dtype], jax.Array]
"""A function of `jax.random`: (key, shape, dtype) -> numbers."""


def key_of(seed: int | jax.Array) -> jax.Array:
    """The key of a seed."""
    return jax.random.key(seed, impl=GENERATOR)


def fold_in_each(key_B: jax.Array, tag: int | jax.Array) -> jax.Array:
    """`jax.random.fold_in(key, tag)` of every key."""
    return jax.vmap(lambda key: jax.random.fold_in(key, tag))(key_B)


def draw_flat(sample: Sample, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The numbers of `sample(key, shape, float32)`. `key` may be an array of keys, each with numbers of its own: the
    result is then [*key.shape, *shape].

    They are drawn as one axis and then reshaped: XLA's CPU compiler takes three to four times as long for three axes as
    for one.
    """
    numbers = jax.vmap(lambda one: sample(one, (math.prod(shape),), jnp.float32))(key.reshape(-1))
    return numbers.reshape(*key.shape, *shape)
