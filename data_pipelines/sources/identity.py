"""Names of episodes that do not depend on other episodes: the file's name, and the position in the file.

Owns these names and the numbers made from them. Splits and subsets hash the numbers, so an episode stays in its split
if others are damaged, missing or skipped.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_pipelines.errors import DataError


@dataclass(frozen=True)
class EpisodeRun:
    """The episodes at positions `first`, ..., `first + count - 1` of one file, readable or not."""

    file: str  # its name without a directory; in a joined dataset preceded by the part's name and a slash
    first: int
    count: int
    split: str = ""  # the files' split, if several are read together ("train+val")


def runs_of_parts(runs: Sequence[EpisodeRun]) -> dict[str, list[EpisodeRun]]:
    """The runs of each part of a joined dataset, in order, with the names that they have in the part alone. Runs of a
    dataset that is not joined belong to ''."""
    parts: dict[str, list[EpisodeRun]] = {}
    for run in runs:
        part, _, file = run.file.rpartition("/")
        parts.setdefault(part, []).append(replace(run, file=file) if part else run)
    return parts


def episode_ids(runs: Sequence[EpisodeRun]) -> np.ndarray:
    """uint64 per episode: the first 8 bytes of the SHA-256 of the file's name, plus the position in the file.

    Raises DataError for two episodes with the same name.
    """
    pieces = [np.zeros(0, np.uint64)]
    for run in runs:
        file = int.from_bytes(hashlib.sha256(run.file.encode()).digest()[:8], "little")
        first = np.uint64((file + run.first) % 2**64)
        with np.errstate(over="ignore"):
            pieces.append(np.arange(run.count, dtype=np.uint64) + first)
    ids = np.concatenate(pieces)
    ordered = np.sort(ids)
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(twice):
        at = int(np.flatnonzero(ids == twice[0])[1])
        raise DataError(
            f"{describe(runs, at)}: two episodes have this name. Give each split, and each file, only once."
        )
    return ids


def describe(runs: Sequence[EpisodeRun], number: int) -> str:
    """The name of the `number`-th episode for a message: file and position."""
    for run in runs:
        if number < run.count:
            return f"{run.file}, episode {run.first + number}"
        number -= run.count
    raise IndexError(number)
