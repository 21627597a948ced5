"""The token store: tokenised episodes of many datasets, with random access.

Owns the reading of what `part_files` writes. Knows nothing of windows or mixtures.
"""

from __future__ import annotations

import os
import resource
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from array_record.python import array_record_module

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.array_record import READ_OPTIONS
from data_pipelines.sources.rlds.location import read_through, retry
from data_pipelines.tokens.episode_record import StoredEpisode, decode_episode
from data_pipelines.tokens.manifest import FILE, SPLITS, Manifest, part_name
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.moments import Moments, merge_exactly, read_moments
from data_pipelines.tokens.part_files import read_actions
from data_pipelines.tokens.row_sample import ActionRange, RowSampler, quantiles_vary, sampled_episodes
from hma_jax.config import ConfigError
from hma_jax.config.json import stable_hash
from hma_jax.model.embodiments import DEAD_STD, EmbodimentTable

_File = tuple[str, str, int]  # dataset, split, part

MAX_OPEN_FILES = 512
"""Files kept open, at most half of those that the process may open. Opening one again takes about as long as reading
two windows: from a mixture of 40 datasets, one core reads 72 thousand frames per second with one part each, and 44
thousand with 25 parts each.
"""


class TokenStore:
    """Opens every dataset under `root`. Thread-safe; pickles (files are reopened).

    Raises DataError if `root` is not a store, a manifest is damaged, or a dataset is in a directory of another name;
    later also if a dataset was replaced or removed meanwhile.
    """

    def __init__(self, root: str | Path):
        self.root = Path(root)
        if not self.root.is_dir():
            raise DataError(f"{self.root}: there is no token store. Tokenise datasets into it first.")
        found = sorted(p.parent for p in self.root.glob(f"*/{FILE}") if not p.parent.name.startswith("."))
        if not found:
            raise DataError(f"{self.root}: the token store is empty. Tokenise datasets into it first.")
        # Read before the contents, so that a replacement in between is noticed.
        self._stamps = {directory.name: _stamp(directory / FILE) for directory in found}
        self._manifests = {directory.name: load_manifest(directory / FILE) for directory in found}
        for directory, manifest in zip(found, self._manifests.values(), strict=True):
            if directory.name != manifest.spec.name:
                raise DataError(
                    f"{directory}: in a token store this directory must have the name of its dataset, "
                    f"{manifest.spec.name!r}. Rename it, or move it out of the store if it is a copy."
                )
        self._start()

    @property
    def names(self) -> tuple[str, ...]:
        """Datasets, sorted."""
        return tuple(self._manifests)

    def manifest(self, name: str) -> Manifest:
        if name not in self._manifests:
            raise ConfigError(
                f"dataset {name!r} is not in the token store {self.root}; it has {', '.join(self.names)}. "
                "Tokenise it first."
            )
        return self._manifests[name]

    def hash(self, names: Sequence[str] | None = None) -> str:
        """Identity of the data: over the manifests of `names`, or of all datasets, in any order."""
        chosen = sorted(self.names if names is None else names)
        return stable_hash({name: self.manifest(name).hash() for name in chosen})

    def embodiment_table(self, names: Sequence[str], rate: float | None) -> EmbodimentTable:
        """The table of `names`, in that order, with statistics of all training actions. Raises what
        `Manifest.embodiment` raises."""
        return EmbodimentTable(tuple(self.manifest(name).embodiment(rate) for name in names))

    def episode(self, name: str, split: str, i: int) -> StoredEpisode:
        """Episode `i` of a split, in store order. Raises DataError for a damaged record, UnreachableError if the disk
        fails."""
        part, at = self._locate(name, split, i)
        try:
            return self._read(name, split, part, at)
        except (DataError, OSError):
            # The library's errors do not distinguish damage from a failed disk. If reading fails again although the
            # file can be read, it is damage; if the file is missing, the second error says so.
            with self._lock:
                self._readers.pop((name, split, part), None)
            with suppress(FileNotFoundError):
                read_through(self._path(name, split, part))
            return self._read(name, split, part, at)

    def _read(self, name: str, split: str, part: int, at: int) -> StoredEpisode:
        reader = self._reader(name, split, part)
        try:
            # A range, since reading a list of records takes time that grows with all records of the file.
            return decode_episode(reader.read(at, at + 1)[0])
        except (RuntimeError, ValueError) as error:
            path = self._path(name, split, part)
            raise DataError(
                f"{path}: episode {at} cannot be read: {error}. Remove {path.parent} and tokenise the dataset again."
            ) from error

    def actions(self, name: str, split: str, i: int) -> np.ndarray:
        """float32 [N, A], a copy: the native actions of episode `i` of a split, without reading its frames if it has
        some. Raises as `episode` does."""
        part, at = self._locate(name, split, i)
        facts = self.manifest(name).split(split)
        with self._checking_not_replaced(name):
            steps = np.asarray(facts.steps[i - at : i - at + facts.parts[part]], np.int64)
            kept = read_actions(self._path(name, split, part), int(steps.sum()))
        if kept is None:
            return self.episode(name, split, i).actions.copy()  # a view would keep the whole record
        first = int(steps[:at].sum())
        return np.array(kept[first : first + steps[at]])

    def action_range(self, name: str, episodes: Sequence[int]) -> ActionRange:
        """The range of the actions of these training episodes only (positions in the store).

        Reads the episodes from which the quantiles are computed, and all of them if some value varies but its quantiles
        do not. Raises DataError for a damaged record.
        """
        facts, episodes = self.manifest(name).train, np.asarray(episodes, np.int64)
        numbers, steps = (np.asarray(column, np.int64)[episodes] for column in (facts.episodes, facts.steps))
        sampler = RowSampler()
        for i in episodes[sampled_episodes(numbers, steps)].tolist():
            item = self.episode(name, "train", i)
            sampler.add(item.actions, item.episode)
        quantiles = sampler.sample().quantiles()
        if not quantiles:
            return ActionRange()
        changing = np.asarray(self.action_moments(name, episodes).std) > DEAD_STD
        if not (changing & ~quantiles_vary(quantiles)).any():
            return ActionRange(quantiles)
        with_steps = (self.episode(name, "train", i).actions for i in episodes[steps > 0].tolist())
        extremes = [(actions.min(axis=0), actions.max(axis=0)) for actions in with_steps]
        low, high = np.min([a for a, _ in extremes], axis=0), np.max([b for _, b in extremes], axis=0)
        return ActionRange(quantiles, tuple(low.tolist()), tuple(high.tolist()))

    def action_moments(self, name: str, episodes: np.ndarray) -> Moments:
        """Statistics of the actions of these training episodes only (int [N], positions in the store).

        Reads the arrays beside each part. Raises as `episode`.
        """
        rows, ends = [], self._ends[name, "train"]
        episodes = np.sort(episodes)
        of_episode = np.searchsorted(ends, episodes, side="right")
        for part in np.unique(of_episode).tolist():
            own = episodes[of_episode == part]
            with self._checking_not_replaced(name):
                kept = read_moments(self._path(name, "train", part), self.manifest(name).train.parts[part])
            rows.append(kept[own - (ends[part - 1] if part else 0)])
        return merge_exactly(np.concatenate(rows), self.manifest(name).spec.action_dim)

    def check_table(self, table: EmbodimentTable, names: Sequence[str], rate: float | None) -> None:
        """Raises ConfigError unless `table` has each of `names` with the action layout stored here, at `rate`."""
        for name in names:
            manifest = self.manifest(name)
            manifest.stride_at(rate)  # raises, if it is not stored
            manifest.spec.check_compatible(table.entries[table.index(name)], rate)

    def _start(self) -> None:
        self._ends = {
            (name, split): np.cumsum(manifest.split(split).parts, dtype=np.int64)
            for name, manifest in self._manifests.items()
            for split in SPLITS
        }
        self._max_open = min(MAX_OPEN_FILES, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
        self._lock = threading.Lock()
        self._readers: OrderedDict[_File, array_record_module.ArrayRecordReader] = OrderedDict()

    def _locate(self, name: str, split: str, i: int) -> tuple[int, int]:
        """(part, position in it) of an episode."""
        self.manifest(name).split(split)  # says so if there is no such dataset or split
        ends = self._ends[name, split]
        part = int(np.searchsorted(ends, i, side="right"))
        if i < 0 or part == len(ends):
            raise IndexError(f"{name}, {split}: episode {i} of {int(ends[-1]) if len(ends) else 0}")
        return part, i - (int(ends[part - 1]) if part else 0)

    def _path(self, name: str, split: str, part: int) -> Path:
        return self.root / name / part_name(split, part, len(self._ends[name, split]))

    def _reader(self, name: str, split: str, part: int) -> array_record_module.ArrayRecordReader:
        key = (name, split, part)
        with self._lock:
            reader = self._readers.get(key)
            if reader is None:
                reader = self._readers[key] = self._open(name, split, part)
                if len(self._readers) > self._max_open:
                    self._readers.popitem(last=False)  # closed when the last thread is done with it
            else:
                self._readers.move_to_end(key)
            return reader

    def _open(self, name: str, split: str, part: int) -> array_record_module.ArrayRecordReader:
        path, expected = self._path(name, split, part), self.manifest(name).split(split).parts[part]
        advice = f"Remove {path.parent} and tokenise the dataset again."
        try:  # the library takes a missing file for one without records
            reader = array_record_module.ArrayRecordReader(str(path), options=READ_OPTIONS)
        except RuntimeError as error:
            raise DataError(f"{path}: not a readable ArrayRecord file ({error}). {advice}") from error
        self._check_not_replaced(name)  # not before: it might be replaced in between
        if _stamp(path) is None:
            raise DataError(f"{path}: the file is missing from the token store. {advice}")
        if reader.num_records() != expected:
            raise DataError(
                f"{path}: {reader.num_records()} episodes, but the manifest says {expected}: "
                f"the file is damaged. {advice}"
            )
        return reader

    def _check_not_replaced(self, name: str) -> None:
        """Raises DataError if the dataset is not the one whose manifest was read: tokens of both would be mixed."""
        path = self.root / name / FILE
        stamp = _stamp(path)
        if stamp == self._stamps[name]:
            return
        if stamp is None:
            raise DataError(
                f"{path.parent}: the dataset was removed while it was in use. Put it back, and run the same command "
                "again."
            )
        if load_manifest(path).hash() != self._manifests[name].hash():
            raise DataError(
                f"{path.parent}: the dataset was replaced while it was in use, and tokens of both must not be mixed. "
                "Start a new run with the new one, or put the old one back and run the same command again."
            )
        self._stamps[name] = stamp

    @contextmanager
    def _checking_not_replaced(self, name: str) -> Iterator[None]:
        """Checks what is read in the block: damaged or not, it may come from a dataset that replaced this one."""
        try:
            yield
        finally:
            self._check_not_replaced(name)  # not before: it might be replaced in between

    def __getstate__(self) -> dict:
        return {"root": self.root, "_manifests": self._manifests, "_stamps": self._stamps}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._start()


def _stamp(path: Path) -> tuple[int, int] | None:
    """Size and modification time of a file; None if there is none. Raises UnreachableError."""
    try:
        status = retry(path, lambda: os.stat(path))
    except FileNotFoundError:
        return None
    return status.st_size, status.st_mtime_ns
