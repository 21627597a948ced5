"""Which episodes are held out and which belong to a subset: chosen by hash, not by order.

Neighbouring episodes of a robot dataset share a scene, a task or a day, so its first 5 % are not a representative
sample. Choosing by a hash of (dataset, episode) is random, needs no file, and is the same for everybody who reads the
dataset. The hash is of the episode's name (`sources.identity`), and the choice is among all episodes that the dataset
should have, so that damaged ones do not change the split of the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.order import hash64, stream_seed
from data_pipelines.sources.identity import EpisodeRun, episode_ids, runs_of_parts
from hma_jax.config import require

VAL_FRACTION, MIN_VAL, MAX_VAL, MAX_VAL_FRACTION = 0.05, 2, 200, 0.25
"""How many episodes are held out, unless a study says otherwise: see `count_held_out`."""


def held_out_episodes(
    spec: DatasetSpec, runs: Sequence[EpisodeRun], fraction: float, min_val: int, max_val: int, max_fraction: float
) -> np.ndarray:
    """bool [episodes that `runs` name], True for validation: the split that the dataset's entry names for that,
    whatever its size, or else as `held_out` chooses. Raises ConfigError if there is no such split.

    Of a joined dataset, `held_out` chooses in each part as if that were a dataset by itself: what is held out of a part
    is new to a model that was trained on the part alone, or joined with others.
    """
    if not spec.val_split:
        bounds = (fraction, min_val, max_val, max_fraction)
        parts = runs_of_parts(runs).items()
        masks = [held_out(part or spec.name, episode_ids(own), *bounds) for part, own in parts]
        return np.concatenate([np.zeros(0, bool), *masks])
    own = [run.split == spec.val_split for run in runs]
    require(
        any(own),
        f"dataset {spec.name!r}: val_split {spec.val_split!r} is not among the splits that are read, {spec.split!r}. "
        "Correct its entry.",
    )
    return np.repeat(own, [run.count for run in runs])


def held_out(
    dataset: str,
    ids: np.ndarray,
    fraction: float = VAL_FRACTION,
    min_val: int = MIN_VAL,
    max_val: int = MAX_VAL,
    max_fraction: float = MAX_VAL_FRACTION,
) -> np.ndarray:
    """bool [episodes], True for validation. `ids`: uint64 [episodes], of all, readable or not.

    `count_held_out` says how many.
    DIFFERS: the release takes the first max(20, 5 %) episodes (reference section 5.1).
    """
    count = count_held_out(len(ids), fraction, min_val, max_val, max_fraction)
    mask = np.zeros(len(ids), bool)
    mask[smallest_hashes(dataset, ids, count, "held-out")] = True
    return mask


def count_held_out(episodes: int, fraction: float, min_val: int, max_val: int, max_fraction: float) -> int:
    """`fraction` of all, at least `min_val` and at most `max_val`, but never more than `max_fraction` of a dataset.

    In a small dataset the last bound decides: with min_val 8 and max_fraction 0.25, two of nine episodes are held
    out. If the other bounds ask for any, at least one of two or more episodes is held out.
    """
    most = max(int(max_fraction * episodes), 1)
    return min(max(round(fraction * episodes), min_val), max_val, most, episodes // 2)


def check_bounds(fraction: float, min_val: int, max_val: int, max_fraction: float, group: str = "") -> None:
    """Raises ConfigError, which names the setting and its `group`, for bounds that `count_held_out` cannot take."""
    require(0 <= fraction < 1, f"{group}val_fraction must lie in [0, 1), got {fraction:g}")
    require(0 <= min_val <= max_val, f"{group}min_val must lie between 0 and {group}max_val, {max_val}, got {min_val}")
    require(0 < max_fraction <= 0.5, f"{group}max_val_fraction must lie in (0, 0.5], got {max_fraction:g}")


def subset(
    dataset: str, ids: np.ndarray, members: np.ndarray, present: np.ndarray, count: int | None, salt: str
) -> np.ndarray:
    """Positions in `present`, ascending, of the episodes among the `count` that are drawn.

    Drawn from `members` (bool per entry of `ids`), whether they are `present` (numbers of episodes) or were skipped:
    a skipped episode that is drawn is not replaced by another.
    """
    numbers = np.flatnonzero(members)
    drawn = np.zeros(len(ids), bool)
    drawn[numbers[smallest_hashes(dataset, ids[numbers], count, salt)]] = True
    return np.flatnonzero(drawn[present])


def smallest_hashes(dataset: str, episodes: np.ndarray, count: int | None, salt: str) -> np.ndarray:
    """Positions, ascending, of the `count` entries of `episodes` with the smallest hash.

    Nested by construction: the positions for a smaller count are among those for a larger.
    """
    if count is None or count >= len(episodes):
        return np.arange(len(episodes))
    order = np.argsort(hash64(episodes, stream_seed(salt, dataset)), kind="stable")
    return np.sort(order[:count])
