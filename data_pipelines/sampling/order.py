"""Seeded order as a pure function of position: hashes, seeds and an endless shuffle.

Owns every pseudo-random choice of the data path except the mixture's (`draws`). There is no generator and no state,
so any position can be computed at any time, in any process, at the same cost and with the same result. Arguments
may be arrays, which broadcast: a batch takes one call.
"""

from __future__ import annotations

import hashlib

import numpy as np

ENDLESS = 1 << 40
"""The length that an endless data source reports to grain: more draws than any run makes, yet small enough for the
sums that grain computes with lengths."""

ROUNDS = 16
"""Rounds of the Feistel cipher, half of them for each half of the bits. With eight, permutations of five items are not
yet nearly equally likely; large sizes need fewer rounds."""

ORDER_VERSION = 2
"""Version of the algorithms here and in `draws`. A run that began with one version does not continue with another.
Version 1 was grain's mixture, a fixed cycle."""


def stream_seed(*parts: str | int) -> int:
    """A 63-bit seed for the stream called `parts`, independent of every other name."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def hash64(values: np.ndarray | int, seed: np.ndarray | int) -> np.ndarray:
    """uint64 per integer: a bijective mix (splitmix64), the same on every machine.

    Seeds may be an array of uint64 that broadcasts against `values`.
    """
    with np.errstate(over="ignore"):  # wrapping multiplication is the point
        x = np.asarray(values).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(seed)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def permute(index: np.ndarray | int, n: np.ndarray | int, key: np.ndarray | int) -> np.ndarray:
    """int64: entry `index` (below `n`) of the permutation of 0..n-1 that `key` (uint64) names.

    An alternating Feistel cipher over the next power of two: each round hashes one half of the bits into
    the other. A result of `n` or more is enciphered again until it is below `n` (cycle-walking), which takes less than
    two passes on average. No size is a special case.
    """
    x, n, key = np.broadcast_arrays(*(np.asarray(a).astype(np.uint64) for a in (index, n, key)))
    shape, x, n, key = x.shape, x.flatten(), n.ravel(), key.ravel()
    walking = np.arange(x.size)
    while walking.size:
        passed = _encipher(x[walking], n[walking], key[walking])
        x[walking] = passed
        walking = walking[passed >= n[walking]]
    return x.astype(np.int64).reshape(shape)[()]


def _encipher(x: np.ndarray, n: np.ndarray, key: np.ndarray) -> np.ndarray:
    """One pass over the smallest power of two that holds 0..n-1; all uint64 [N]."""
    one = np.uint64(1)
    bits = np.frexp((n - one).astype(np.float64))[1].astype(np.uint64)  # exact up to 2^53
    low_bits = (bits + one) >> one
    masks = ((one << low_bits) - one, (one << (bits - low_bits)) - one)
    halves = [x & masks[0], x >> low_bits]
    keys = hash64(np.arange(ROUNDS)[:, None], key)
    for at, round_key in enumerate(keys):
        to, source = (at + 1) % 2, at % 2
        halves[to] = halves[to] ^ (_mix(halves[source], round_key) & masks[to])
    return (halves[1] << low_bits) | halves[0]


def _mix(x: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Up to 32 bits of uint64 `x` and `key`; arrays of numpy wrap without a warning."""
    x = (x ^ key) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return x >> np.uint64(32)


def endless_shuffle(position: np.ndarray | int, n: np.ndarray | int, seed: np.ndarray | int) -> np.ndarray:
    """int64: entry `position` of an endless sequence of independent permutations of 0..n-1."""
    epoch, index = np.divmod(np.asarray(position, np.int64), np.asarray(n, np.int64))
    return permute(index, n, hash64(epoch, np.asarray(seed).astype(np.uint64)))


def random_below(limit: int, position: int, seed: int) -> int:
    """A number in 0..limit-1 that depends only on (position, seed)."""
    return int(hash64(position, seed)) % limit
