"""Every random number of an evaluation, as a function of the seed and of its purpose.

A window is identified by its robot's name, its episode and its start. No number depends on the other robots in the
table, the width of the widest robot's chunks, the batch, the row in it or the devices. So every trial, and every model
to which robots were added, is judged with the same numbers.
"""

from __future__ import annotations

import functools
import hashlib
from statistics import NormalDist
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.kernels.random import draw_flat, key_of
from hma_jax.model.embodiments import EmbodimentTable

Purpose = Literal["actions", "decoding", "likelihood", "policy"]
"""What random numbers are for; each purpose has its own numbers."""


def window_keys(
    seed: int,
    purpose: Purpose,
    table: EmbodimentTable,
    embodiment_B: jax.Array,
    episode_B: jax.Array,
    start_B: jax.Array,
) -> jax.Array:
    """A key for each window, [B]."""
    base = jax.random.fold_in(key_of(seed), get_args(Purpose).index(purpose))
    name_E = jnp.asarray([_hash_of(name) for name in table.names], jnp.uint32)

    def one(*name: jax.Array) -> jax.Array:
        key = base
        for part in name:
            key = jax.random.fold_in(key, part)
        return key

    return jax.vmap(one)(name_E[embodiment_B], episode_B, start_B)


def random_actions(key_B: jax.Array, statistics: tuple[jax.Array, jax.Array], draws: int, frames: int) -> jax.Array:
    """[B, draws, T = frames, U]: N(mean, std) by `statistics` (mean, std), float32 [B, U] each, both 0 in the padding.

    The statistics should be those of all recorded actions: a table's may be those of the training subset only.

    Every value of a chunk has a key of its own: a wider robot in the table adds keys and changes none. The result is
    the same, bit for bit, in batches of any shape.
    """
    mean_BU, std_BU = statistics
    of_window = jax.vmap(jax.random.fold_in, (None, 0))
    key_BU = jax.vmap(of_window, (0, None))(key_B, jnp.arange(mean_BU.shape[1]))
    noise = jnp.moveaxis(draw_flat(_normal, key_BU, (draws, frames)), 1, -1)
    # Without the barrier, compilers fuse product and sum for some shapes, and round once less.
    from_mean = jax.lax.optimization_barrier(std_BU[:, None, None] * noise)
    return mean_BU[:, None, None] + from_mean


def table_statistics(embodiment_B: jax.Array, table: EmbodimentTable) -> tuple[jax.Array, jax.Array]:
    """(mean, std), [B, U] each, of the table."""
    mean_EU, std_EU = table.statistics()
    return jnp.asarray(mean_EU)[embodiment_B], jnp.asarray(std_EU)[embodiment_B]


QUANTILES = 2**16


@functools.cache
def _quantiles() -> np.ndarray:
    """float32: equally likely values of N(0, 1)."""
    normal = NormalDist()
    return np.asarray([normal.inv_cdf((i + 0.5) / QUANTILES) for i in range(QUANTILES)], np.float32)


def _normal(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """N(0, 1) to 16 bits, from a table: `jax.random.normal` computes a logarithm, whose last bit depends on the shape
    of the array and on the processor."""
    return jnp.asarray(_quantiles(), dtype)[jax.random.bits(key, shape, jnp.uint32) >> 16]


def _hash_of(name: str) -> np.uint32:
    """A hash that is the same on every machine and in every version: results depend on it."""
    return np.frombuffer(hashlib.sha256(name.encode()).digest()[:4], "<u4")[0]
