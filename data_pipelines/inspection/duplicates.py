"""Finds episodes that are probably the same recording, within a split or across splits.

The fingerprint is robust to recompression and resizing: thumbnails of an episode's first and last frames, and its
actions at sixteen times. A fixed camera shows much the same in every episode, so images alone are not enough: if
actions vary, they must match too.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.sources.rlds.images import fit_image
from hma_jax.model.embodiments import DEAD_STD

SIDE = 16
"""An image is compared as SIDE x SIDE grey cells of its central square."""

SAME_PICTURE = 7.0
"""Grey levels, root mean square over the cells. The same frame of the three real samples compressed again
or at 5/8 of its size differs by at most 5.3, frames of two episodes by 18 or more."""

TIMES = 16
SAME_ACTIONS = 0.02
"""Number of standard deviations by which every compared action may differ."""


@dataclass(frozen=True)
class Fingerprint:
    """What is compared of one episode."""

    split: str
    index: int
    steps: int
    pictures: np.ndarray  # float64 [2 for every camera, SIDE, SIDE], the first and the last frame
    actions: np.ndarray  # float64 [TIMES, A]

    @property
    def name(self) -> str:
        return f"{self.split} {self.index}"


def coarse(frame: np.ndarray) -> np.ndarray:
    """float64 [SIDE, SIDE]: the mean grey of each cell of a frame [H, W, 3]."""
    return fit_image(frame, 4 * SIDE).mean(axis=2).reshape(SIDE, 4, SIDE, 4).mean(axis=(1, 3))


def take_fingerprint(
    split: str, index: int, steps: int, frames: dict[str, Sequence[np.ndarray]], actions: Sequence[np.ndarray]
) -> Fingerprint:
    """The fingerprint of an episode: of the first and last of its `frames` by camera, and of fields of `actions` [N,
    A]."""
    pictures = [coarse(own[at]) for _, own in sorted(frames.items()) for at in (0, -1)]
    times = np.linspace(0, steps - 1, TIMES).round().astype(int)
    rows = [np.asarray(field, np.float64)[times] for field in actions]
    pictures = np.reshape(pictures, (-1, SIDE, SIDE))
    return Fingerprint(split, index, steps, pictures, np.concatenate([np.zeros((TIMES, 0)), *rows], axis=1))


def find_duplicates(episodes: Sequence[Fingerprint]) -> list[tuple[Fingerprint, ...]]:
    """Groups of two or more that are probably one recording, each in the order given."""
    if not episodes:
        return []
    rows = _finite(np.stack([e.actions for e in episodes]))
    scale = rows.std(axis=(0, 1))
    alive = scale > DEAD_STD
    actions = (rows[:, :, alive] / scale[alive]).reshape(len(episodes), -1)
    groups: dict[int, list[Fingerprint]] = {}  # by the number of their first episode
    firsts: defaultdict[tuple[int, int], list[int]] = defaultdict(list)  # by length, cameras
    for n, episode in enumerate(episodes):
        alike = firsts[episode.steps, len(episode.pictures)]
        near = (np.abs(actions[alike] - actions[n]) <= SAME_ACTIONS).all(axis=1)
        for first in np.asarray(alike, int)[near].tolist():
            if _same_pictures(episodes[first], episode, bool(alive.any())):
                groups[first].append(episode)
                break
        else:
            alike.append(n)
            groups[n] = [episode]
    return [tuple(group) for group in groups.values() if len(group) > 1]


def _finite(actions: np.ndarray) -> np.ndarray:
    """Replaces NaN and infinity by 0: one infinite value would make all others of its column equal after scaling."""
    return np.nan_to_num(actions, nan=0.0, posinf=0.0, neginf=0.0)


def _same_pictures(a: Fingerprint, b: Fingerprint, actions_vary: bool) -> bool:
    if not actions_vary and not (a.pictures.std(axis=(1, 2)) > SAME_PICTURE).any():
        return False  # blank images and constant actions: episodes cannot be told apart
    return not (np.sqrt(((a.pictures - b.pictures) ** 2).mean(axis=(1, 2))) > SAME_PICTURE).any()
