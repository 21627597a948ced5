"""Which episodes are held out and which belong to a subset: by hash, never by order.

Neighbouring episodes of a robot dataset share a scene, a task or a day, so the first 5 %
are no sample of it. A hash of (dataset, episode) is one, needs no file, and is the same for
everybody who reads the dataset.
"""

from __future__ import annotations

import numpy as np

from data_pipelines.sampling.order import hash64, stream_seed


def held_out(
    dataset: str,
    episodes: int,
    fraction: float = 0.05,
    min_val: int = 2,
    max_val: int = 200,
    max_fraction: float = 0.25,
) -> np.ndarray:
    """bool [episodes], True for validation; see `count_held_out` for their number.

    DIFFERS: the release takes the first max(20, 5 %) episodes (reference section 5.1).
    """
    count = count_held_out(episodes, fraction, min_val, max_val, max_fraction)
    mask = np.zeros(episodes, bool)
    mask[smallest_hashes(dataset, np.arange(episodes), count, "held-out")] = True
    return mask


def count_held_out(episodes: int, fraction: float, min_val: int, max_val: int, max_fraction: float) -> int:
    """`fraction` of all, at least `min_val` and at most `max_val`, but never more than `max_fraction` of a dataset.

    Of a small dataset the last decides: with min_val 8, two of nine episodes are held out, not four. One is, of
    two episodes or more, unless `max_val` is 0.
    """
    most = max(int(max_fraction * episodes), 1)
    return min(max(round(fraction * episodes), min_val), max_val, most, episodes // 2)


def smallest_hashes(dataset: str, episodes: np.ndarray, count: int | None, salt: str) -> np.ndarray:
    """Positions, ascending, of the `count` entries of `episodes` with the smallest hash.

    Nested by construction: the positions for a smaller count are among those for a larger.
    """
    if count is None or count >= len(episodes):
        return np.arange(len(episodes))
    order = np.argsort(hash64(episodes, stream_seed(salt, dataset)), kind="stable")
    return np.sort(order[:count])
