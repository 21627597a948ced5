"""The numbers of every window: one row per window, from which all means are computed.

On disk it is a Parquet file in long form, with a row for every window and metric. pandas, polars, DuckDB and R read it
directly, and tables of several trials are joined by concatenation:

    trial     name of the trial, or of the directory of a model that is evaluated alone
    robot     name of the dataset, which is that of the robot
    episode   number of the episode in its source
    window    first native frame of the window in the episode
    frames    real frames of the window; what is left of the model's T is padding, which no number counts
    metric    (`protocol`, `images`)
    value     float32, as devices compute it

(robot, episode, window) identifies a window: it is the same in every evaluation of any model, whatever other datasets
there are. Within a metric, rows stand in the order of the frozen manifest.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    import pyarrow as pa

FILE = "windows.parquet"
COLUMNS = ("dataset", "episode", "start", "frames")
"""Fields of a `WindowTable` besides its metrics."""


@dataclass(frozen=True, repr=False)
class WindowTable:
    """Columns of equal length, a row per window."""

    dataset: np.ndarray  # str
    episode: np.ndarray  # int64
    start: np.ndarray  # int64
    frames: np.ndarray  # int64: number of real frames
    metrics: Mapping[str, np.ndarray]  # float64

    def __post_init__(self):
        lengths = {len(column) for column in (*(getattr(self, name) for name in COLUMNS), *self.metrics.values())}
        require(len(lengths) == 1, f"the columns of a table of windows differ in length: {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.dataset)

    def __repr__(self) -> str:
        return f"<{len(self)} windows of {', '.join(self.datasets)}: {', '.join(self.metrics)}>"

    @cached_property
    def datasets(self) -> tuple[str, ...]:
        """The names of the datasets, in the order of their first windows."""
        return tuple(dict.fromkeys(self.dataset.tolist()))

    @property
    def names(self) -> list[tuple[str, int, int]]:
        """(dataset, episode, start) of every window."""
        columns = (self.dataset.tolist(), self.episode.tolist(), self.start.tolist())
        return list(zip(*columns, strict=True))

    @cached_property
    def distinct(self) -> bool:
        """Whether no window occurs twice."""
        return len(set(self.names)) == len(self)

    def of(self, dataset: str) -> WindowTable:
        """The windows of one dataset."""
        return self.rows(np.flatnonzero(self.dataset == dataset))

    def among(self, datasets: Sequence[str]) -> WindowTable:
        """The windows of some datasets, in the order of this table."""
        if set(self.datasets) <= set(datasets):
            return self
        return self.rows(np.flatnonzero(np.isin(self.dataset, list(datasets))))

    def rows(self, index: np.ndarray) -> WindowTable:
        metrics = {name: column[index] for name, column in self.metrics.items()}
        return WindowTable(*(getattr(self, name)[index] for name in COLUMNS), metrics)

    def has_windows_of(self, other: WindowTable) -> bool:
        """Whether this table has exactly the windows of `other`, in the same order, and none twice."""
        named = ("dataset", "episode", "start")
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in named) and self.distinct

    def aligned_to(self, other: WindowTable) -> WindowTable:
        """The same windows in the order of `other`. Raises ConfigError, which names the first window that differs, if
        the two tables have different windows, or one has a window twice."""
        if self.has_windows_of(other):  # as trials of one study do
            return self
        own, wanted = self.names, other.names
        at = {name: i for i, name in enumerate(own)}
        for names in (own, wanted):
            twice = next((name for name, times in Counter(names).items() if times > 1), None)
            require(twice is None, f"an evaluation contains a window twice: {twice}")
        unmatched = sorted(set(own) ^ set(wanted))
        require(
            not unmatched,
            f"only one of the two evaluations has window {unmatched and unmatched[0]} (and {len(unmatched) - 1} "
            "others); compare evaluations on one frozen set of windows",
        )
        return self.rows(np.asarray([at[name] for name in wanted], np.int64))

    def to_arrow(self, trial: str) -> pa.Table:
        """The long form; `trial` is the name of the trial in every row."""
        import pyarrow as pa

        metrics, n = len(self.metrics), len(self)

        def names(of: Sequence[str], index: np.ndarray) -> pa.DictionaryArray:
            return pa.DictionaryArray.from_arrays(pa.array(index, pa.int32()), pa.array(list(of), pa.string()))

        def number(column: np.ndarray, kind: pa.DataType) -> pa.Array:
            return pa.array(np.tile(column, metrics), kind)

        robots = self.datasets
        robot = np.asarray([robots.index(name) for name in self.dataset.tolist()], np.int32)
        values = [np.asarray(column, np.float32) for column in self.metrics.values()]
        return pa.table(
            {
                "trial": names([trial], np.zeros(metrics * n, np.int32)),
                "robot": names(robots, np.tile(robot, metrics)),
                "episode": number(self.episode, pa.int32()),
                "window": number(self.start, pa.int32()),
                "frames": number(self.frames, pa.int16()),
                "metric": names(list(self.metrics), np.repeat(np.arange(metrics), n)),
                "value": pa.array(np.concatenate([np.zeros(0, np.float32), *values]), pa.float32()),
            }
        )

    @classmethod
    def from_arrow(cls, table: pa.Table) -> WindowTable:
        """The inverse, for one trial's rows with metrics in any order. Raises ValueError unless every metric has the
        same windows in the same order."""
        (metrics, metric), (trials, trial), (robots, robot) = (_coded(table[n]) for n in ("metric", "trial", "robot"))
        codes, firsts = np.unique(metric, return_index=True)
        codes = codes[np.argsort(firsts)]
        names, blocks = [metrics[code] for code in codes], [np.flatnonzero(metric == code) for code in codes]
        if not blocks or len({trials[code] for code in np.unique(trial)}) != 1:
            raise ValueError("it contains no trial, or several")
        columns = {"robot": robot} | {n: table[n].to_numpy() for n in ("episode", "window", "frames", "value")}
        first = {name: column[blocks[0]] for name, column in columns.items()}
        for name, block in zip(names, blocks, strict=True):
            if any(not np.array_equal(columns[c][block], first[c]) for c in ("robot", "episode", "window", "frames")):
                raise ValueError(f"{name} has other windows than {names[0]}")
        whole = (np.asarray(first[name], np.int64) for name in ("episode", "window", "frames"))
        values = {n: columns["value"][block].astype(np.float64) for n, block in zip(names, blocks, strict=True)}
        return cls(np.asarray(robots, str)[first["robot"]], *whole, values)

    def save(self, path: str | Path, trial: str) -> None:
        """Writes the Parquet file, whole or not at all, with the same bytes for the same numbers."""
        write_arrow(Path(path), self.to_arrow(trial))

    @classmethod
    def load(cls, path: str | Path) -> WindowTable:
        """Reads what `save` wrote. Raises ConfigError if it is missing or damaged."""
        import pyarrow as pa

        try:
            return cls.from_arrow(read_arrow(path))
        except (OSError, ValueError, KeyError, pa.ArrowException) as error:
            raise ConfigError(f"{path}: the table of windows cannot be read ({error}). Evaluate again.") from error


def write_arrow(path: Path, table: pa.Table) -> None:
    """Writes a table as Parquet, with checksums; whole or not at all."""
    import pyarrow.parquet as pq

    content = io.BytesIO()
    pq.write_table(table, content, compression="zstd", write_page_checksum=True)
    write_file(path, content.getvalue())


def read_arrow(path: str | Path) -> pa.Table:
    """What `write_arrow` wrote. Raises OSError or pyarrow's exceptions."""
    import pyarrow.parquet as pq

    with open(path, "rb") as file:  # its own error for a file that is not there
        return pq.read_table(file, page_checksum_verification=True)


def _coded(column: pa.ChunkedArray) -> tuple[list[str], np.ndarray]:
    """The names in a column, and for every row the index of its name. Raises ValueError where a name is missing."""
    import pyarrow as pa

    coded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    whole = coded.unify_dictionaries().combine_chunks()
    names = whole.dictionary.to_pylist()
    if whole.null_count or len(set(names)) < len(names):
        raise ValueError("a name is missing, or is twice in the list of names")
    return names, whole.indices.to_numpy()


def join(tables: Sequence[WindowTable]) -> WindowTable:
    """One table after the other. Raises ConfigError if there is none."""
    require(len(tables) > 0, "the evaluation has no windows; freeze windows of other datasets")
    columns = (np.concatenate([getattr(t, name) for t in tables]) for name in COLUMNS)
    metrics = {m: np.concatenate([t.metrics[m] for t in tables]) for m in tables[0].metrics}
    return WindowTable(*columns, metrics)
