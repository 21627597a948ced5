"""Which episodes are held out and which belong to a subset: chosen by hash, not by order.

Neighbouring episodes of a robot dataset share a scene, a task or a day, so its first 5 % are not a representative
sample. Choosing by a hash of (dataset, episode) is random, needs no file, and is the same for everybody who reads the
dataset. The hash is of the episode's name (`sources.identity`), and the choice is made among all episodes that the
dataset should have, so that damaged ones do not change the split of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.order import hash64, stream_seed
from data_pipelines.sources.identity import EpisodeRun, episode_ids, runs_of_parts
from hma_jax.config import require
from hma_jax.config.base import later


@dataclass(frozen=True)
class HeldOut:
    """How many episodes of a dataset are held out, and how many at most are trained on. Studies and token stores have
    these settings, and others besides."""

    val_fraction: float = 0.05  # fraction of episodes that are held out
    min_val: int = 2  # smallest number of held-out episodes per dataset
    max_val: int = 200  # largest number of held-out episodes per dataset
    # Largest fraction of a dataset that is held out; takes precedence over min_val.
    max_val_fraction: float = 0.25
    # Largest number of training episodes per dataset, chosen by hash as by --trajectories; others are not tokenised.
    # If it is set, at most max_val episodes are tokenised of a split that an entry holds out. null: all episodes.
    max_train: int | None = later(None)

    @property
    def held_out(self) -> HeldOut:
        """These settings alone, of a class that has more."""
        return HeldOut(self.val_fraction, self.min_val, self.max_val, self.max_val_fraction, self.max_train)

    def count(self, episodes: int) -> int:
        """`val_fraction` of all, at least `min_val` and at most `max_val`, but never more than `max_val_fraction`.

        In a small dataset the last bound decides: with min_val 8 and max_val_fraction 0.25, two of nine episodes are
        held out. If the other bounds ask for any, at least one of two or more episodes is held out.
        """
        most = max(int(self.max_val_fraction * episodes), 1)
        return min(max(round(self.val_fraction * episodes), self.min_val), self.max_val, most, episodes // 2)

    def check(self, group: str = "") -> None:
        """Raises ConfigError, naming the setting and its `group`, for bounds that `count` cannot use."""
        fraction, low, high, most = self.val_fraction, self.min_val, self.max_val, self.max_val_fraction
        require(0 <= fraction < 1, f"{group}val_fraction must lie in [0, 1), got {fraction:g}")
        require(0 <= low <= high, f"{group}min_val must lie between 0 and {group}max_val, {high}, got {low}")
        require(0 < most <= 0.5, f"{group}max_val_fraction must lie in (0, 0.5], got {most:g}")
        train = self.max_train
        require(train is None or train >= 1, f"{group}max_train must be at least 1, got {train}")

    def used(self, train: int, val: int, own_split: bool) -> tuple[int, int]:
        """How many of `train` episodes and of `val` held-out ones are used; `own_split`: the entry of the dataset says
        which split is held out."""
        if self.max_train is None:
            return train, val
        return min(train, self.max_train), min(val, self.max_val) if own_split else val


def held_out_episodes(spec: DatasetSpec, runs: Sequence[EpisodeRun], amount: HeldOut) -> np.ndarray:
    """bool [episodes that `runs` name], True for validation: the split that the dataset's entry names for this,
    whatever its size, or else the choice of `held_out`. Raises ConfigError if there is no such split.

    In a joined dataset, `held_out` chooses in each part as if it were a dataset on its own: what is held out of a part
    is new to every model, whether it was trained on that part alone or joined with others.
    """
    if not spec.val_split:
        parts = runs_of_parts(runs).items()
        masks = [held_out(part or spec.name, episode_ids(own), amount) for part, own in parts]
        return np.concatenate([np.zeros(0, bool), *masks])
    own = [run.split == spec.val_split for run in runs]
    require(
        any(own),
        f"dataset {spec.name!r}: val_split {spec.val_split!r} is not among the splits that are read, {spec.split!r}. "
        "Correct its entry.",
    )
    return np.repeat(own, [run.count for run in runs])


def used_episodes(spec: DatasetSpec, runs: Sequence[EpisodeRun], amount: HeldOut) -> tuple[np.ndarray, np.ndarray]:
    """(bool, bool) [episodes that `runs` name], True for those to train on, and for those held out. Without
    `amount.max_train` each episode is one or the other.

    With it, those to train on are the ones that a run limited to the same number of trajectories draws with seed 0, if
    all are long enough for a window. The held-out ones stay the same; of a split that the entry names, at most
    `amount.max_val` are used, so that using a part of a large dataset does not require all of that split. Raises what
    `held_out_episodes` does.
    """
    val = held_out_episodes(spec, runs, amount)
    train = ~val
    if amount.max_train is None:
        return train, val
    ids = episode_ids(runs)
    most = amount.used(int(train.sum()), int(val.sum()), bool(spec.val_split))
    return drawn(spec.name, ids, train, most[0], subset_salt(0)), drawn(spec.name, ids, val, most[1], "held-out")


def held_out(dataset: str, ids: np.ndarray, amount: HeldOut) -> np.ndarray:
    """bool [episodes], True for validation. `ids`: uint64 [episodes], of all, readable or not.

    DIFFERS: the release takes the first max(20, 5 %) episodes (reference section 5.1).
    """
    mask = np.zeros(len(ids), bool)
    mask[smallest_hashes(dataset, ids, amount.count(len(ids)), "held-out")] = True
    return mask


def subset(
    dataset: str, ids: np.ndarray, members: np.ndarray, present: np.ndarray, count: int | None, salt: str
) -> np.ndarray:
    """Draws `count` episodes, and returns the positions in `present`, ascending, of those that are present.

    `members`: bool per entry of `ids`, the episodes to draw from; `present`: numbers of those that were not skipped. A
    skipped episode that is drawn is not replaced by another.
    """
    return np.flatnonzero(drawn(dataset, ids, members, count, salt)[present])


def subset_salt(seed: int) -> str:
    """The `salt` of the subsets of trajectories that a run of this seed trains on."""
    return f"subset/{seed}"


def drawn(dataset: str, ids: np.ndarray, members: np.ndarray, count: int | None, salt: str) -> np.ndarray:
    """bool per entry of `ids`: which `count` (None: all) of the `members` (bool per entry) are drawn."""
    numbers, mask = np.flatnonzero(members), np.zeros(len(ids), bool)
    mask[numbers[smallest_hashes(dataset, ids[numbers], count, salt)]] = True
    return mask


def smallest_hashes(dataset: str, episodes: np.ndarray, count: int | None, salt: str) -> np.ndarray:
    """Positions, ascending, of the `count` entries of `episodes` with the smallest hash.

    Nested by construction: the positions for a smaller count are among those for a larger.
    """
    if count is None or count >= len(episodes):
        return np.arange(len(episodes))
    order = np.argsort(hash64(episodes, stream_seed(salt, dataset)), kind="stable")
    return np.sort(order[:count])
