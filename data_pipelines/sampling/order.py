"""Seeded order as a pure function of position: hashes, seeds and an endless shuffle.

Owns every pseudo-random choice of the data path. No generator is advanced anywhere, so any
position can be asked for at any time, in any process, and gives the same answer.
"""

from __future__ import annotations

import functools
import hashlib

import grain.experimental
import numpy as np

SMALL = 1 << 16
"""Up to here a whole epoch's permutation is made and kept; beyond, it is a block cipher."""

ENDLESS = 1 << 40
"""Length that an endless source states: more draws than any run makes, yet small enough for
the sums that grain does with lengths."""


def stream_seed(*parts: str | int) -> int:
    """A 63-bit seed for the stream called `parts`, independent of every other name."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def hash64(values: np.ndarray, seed: int | np.ndarray) -> np.ndarray:
    """uint64 per integer: a bijective mix (splitmix64), the same on every machine.

    Seeds may be an array of uint64 that broadcasts against `values`.
    """
    with np.errstate(over="ignore"):  # wrapping multiplication is the point
        x = np.asarray(values).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(seed)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def endless_shuffle(position: int, n: int, seed: int) -> int:
    """Entry `position` of an endless sequence of independent permutations of 0..n-1.

    grain's own shuffle walks a cipher over at least 2^16 values until it meets one below n:
    fast for large n, but a millisecond per draw for the ten trajectories of a small subset.
    """
    epoch, index = divmod(position, n)
    if n > SMALL:
        key = int(hash64(epoch, seed)) & 0xFFFFFFFF
        return grain.experimental.index_shuffle(index, max_index=n - 1, seed=key, rounds=4)
    return int(_permutation(n, seed, epoch)[index])


@functools.lru_cache(maxsize=128)
def _permutation(n: int, seed: int, epoch: int) -> np.ndarray:
    key = int(hash64(epoch, seed))
    return np.argsort(hash64(np.arange(n), key), kind="stable").astype(np.uint16 if n < SMALL else np.int32)


def random_below(limit: int, position: int, seed: int) -> int:
    """A number in 0..limit-1 that depends on (position, seed) alone."""
    return int(hash64(position, seed)) % limit
