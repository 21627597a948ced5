"""Every window's numbers: one row per window, from which all means follow.

On disk a gzipped CSV, which pandas (`pandas.read_csv("windows.csv.gz")`), R or a spreadsheet opens as it
is; numbers are written so that reading them gives the same float64 again. Columns:

    dataset   name of the dataset, which is that of the robot
    episode   number of the episode in its source
    start     first native frame of the window in the episode
    ...       one column per metric (`protocol`, `images`)

(dataset, episode, start) names a window: the same one in every evaluation of any model, whatever
other datasets there are. Rows stand in the order of the frozen manifest.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hma_jax.config import ConfigError, require

FILE = "windows.csv.gz"
NAME = ("dataset", "episode", "start")
"""Columns that name a window."""


@dataclass(frozen=True)
class WindowTable:
    """Columns of equal length, a row per window."""

    dataset: np.ndarray  # str
    episode: np.ndarray  # int64
    start: np.ndarray  # int64
    metrics: Mapping[str, np.ndarray]  # float64

    def __post_init__(self):
        lengths = {len(column) for column in (self.dataset, self.episode, self.start, *self.metrics.values())}
        require(len(lengths) == 1, f"the columns of a table of windows differ in length: {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.dataset)

    @property
    def datasets(self) -> tuple[str, ...]:
        """In the order of their first windows."""
        return tuple(dict.fromkeys(self.dataset.tolist()))

    @property
    def names(self) -> list[tuple[str, int, int]]:
        """(dataset, episode, start) of every window."""
        columns = (self.dataset.tolist(), self.episode.tolist(), self.start.tolist())
        return list(zip(*columns, strict=True))

    def of(self, dataset: str) -> WindowTable:
        """The windows of one dataset."""
        return self.rows(np.flatnonzero(self.dataset == dataset))

    def rows(self, index: np.ndarray) -> WindowTable:
        metrics = {name: column[index] for name, column in self.metrics.items()}
        return WindowTable(self.dataset[index], self.episode[index], self.start[index], metrics)

    def matched_to(self, other: WindowTable) -> WindowTable:
        """The same windows in the order of `other`. Raises ConfigError if `other` has others."""
        mine, theirs = self.names, other.names
        at = {name: i for i, name in enumerate(mine)}
        strangers = sorted(set(mine) ^ set(theirs))
        require(
            not strangers,
            f"only one of two evaluations has window {strangers and strangers[0]} (and {len(strangers) - 1} others); "
            "compare evaluations on one frozen set of windows",
        )
        return self.rows(np.asarray([at[name] for name in theirs], np.int64))

    def save(self, path: str | Path) -> None:
        """Writes the CSV; whole or not at all, and the same bytes for the same numbers."""
        path, text = Path(path), io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*NAME, *self.metrics])
        columns = [column.tolist() for column in (self.dataset, self.episode, self.start, *self.metrics.values())]
        writer.writerows(zip(*columns, strict=True))
        aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        aside.write_bytes(gzip.compress(text.getvalue().encode(), mtime=0))
        os.replace(aside, path)

    @classmethod
    def load(cls, path: str | Path) -> WindowTable:
        """Reads what `save` wrote. Raises ConfigError if it is missing or damaged."""
        try:
            with gzip.open(path, "rt", newline="") as file:
                head, *lines = csv.reader(file)
            require(tuple(head[:3]) == NAME, f"its first columns are {', '.join(head[:3])}, not {', '.join(NAME)}")
            columns = list(zip(*lines, strict=True)) or [()] * len(head)
            dataset, episode, start, *metrics = columns
            numbers = {name: np.asarray(c, np.float64) for name, c in zip(head[3:], metrics, strict=True)}
            return cls(np.asarray(dataset, str), np.asarray(episode, np.int64), np.asarray(start, np.int64), numbers)
        except (OSError, EOFError, ValueError, zlib.error, csv.Error) as error:
            raise ConfigError(f"{path}: no table of windows can be read ({error}). Evaluate again.") from error


def join(tables: Sequence[WindowTable]) -> WindowTable:
    """One table after the other. Raises ConfigError if there is none."""
    require(len(tables) > 0, "the evaluation has no windows; freeze a manifest over other datasets")
    dataset, episode, start = (np.concatenate([getattr(t, name) for t in tables]) for name in NAME)
    metrics = {m: np.concatenate([t.metrics[m] for t in tables]) for m in tables[0].metrics}
    return WindowTable(dataset, episode, start, metrics)
