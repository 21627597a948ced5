"""An RLDS dataset directory as an `EpisodeSource`, without TensorFlow.

Owns reading what tfds wrote: schema, shards, records, one camera and the action of an episode. Knows neither
tokenizers nor windows nor which camera a dataset is used with (see `registry`). Metadata is read by `schema`, records
by `tfrecord` and `example`, from a disk or a remote store (see `location`).
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, without_advice
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.rlds import array_record
from data_pipelines.sources.rlds.example import Feature, parse_record
from data_pipelines.sources.rlds.frame_spans import FrameSpanCache
from data_pipelines.sources.rlds.index import index_path, load_index
from data_pipelines.sources.rlds.location import OpenFiles, is_remote, missing_shard
from data_pipelines.sources.rlds.schema import (
    field_slice,
    listing,
    read_info,
    read_metadata,
    read_rate,
    resolve_version,
    step_key,
)
from data_pipelines.sources.rlds.steps import load_steps, save_steps
from data_pipelines.sources.rlds.tfrecord import open_record, read_parts, scan_shard
from data_pipelines.sources.source import (
    MAX_SKIPPED,
    SUCCESS_KEY,
    Corrupt,
    EpisodeSource,
    OpenEpisode,
    decode_frame,
    find_success,
    join_actions,
)

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


class RldsDataset(EpisodeSource):
    """The episodes of one split of an RLDS directory, or of several one after the other ("train+val"); its shards
    are TFRecord or ArrayRecord files.

    `directory`, a path or URL, is a version directory (`<name>/1.0.0`) or its parent, in which case the newest version
    is used. Shards are indexed once, for all later starts (see `index`).

    Several datasets may share `files`, so that the number of open files does not grow with the number of datasets.

    Raises DataError for a directory that is not a dataset, for missing or damaged shards, and for a record count that
    contradicts dataset_info.json; ConfigError for an unknown split.
    """

    def __init__(
        self,
        directory: str | Location,
        split: str = "train",
        *,
        corrupt: Corrupt = "raise",
        max_skipped: float = MAX_SKIPPED,
        files: OpenFiles | None = None,
    ):
        super().__init__(corrupt, max_skipped)
        self.directory = self.location = resolve_version(directory)
        self.schema = self.directory / "features.json"
        self.split = split
        self._files = OpenFiles() if files is None else files
        self._span_cache = FrameSpanCache()
        meta = read_metadata(self.directory, split)
        self.name, self.version = meta.name, meta.version
        self.features = meta.features
        self.runs = tuple(
            EpisodeRun(path.name, 0, count, part if "+" in split else "")
            for path, count, part in zip(meta.shards, meta.shard_lengths, meta.shard_splits, strict=True)
        )
        self.files = len(meta.shards)
        self._paths, self._in_array_records = meta.shards, meta.file_format == "array_record"
        scan = array_record.scan_shard if self._in_array_records else scan_shard
        self._index = load_index(self.directory, split, meta.shards, scan)
        self._check_shards(meta.shard_lengths)

    def __len__(self) -> int:
        return len(self._index)

    @property
    def numbers(self) -> np.ndarray:
        records = np.diff(self._index.ends, prepend=0)
        declared = np.asarray([run.count for run in self.runs], np.int64)
        missing_before = np.cumsum(declared) - declared - (self._index.ends - records)
        return np.arange(len(self), dtype=np.int64) + np.repeat(missing_before, records)

    @functools.cached_property
    def hz(self) -> float | None:
        return read_rate(self.directory)

    def fingerprint(self) -> str:
        """Hash over the shards' names and sizes and the length and checksum of every record."""
        digest = hashlib.sha256()
        for shard in self._index.shards:
            digest.update(f"{shard.name}:{shard.size};".encode())
        digest.update(self._index.lengths.astype("<i8").tobytes())
        digest.update(self._index.checksums.astype("<u4").tobytes())
        return digest.hexdigest()[:16]

    def sizes(self) -> np.ndarray:
        """int64 [episodes]: bytes of each record."""
        return self._index.lengths

    def steps(self) -> np.ndarray:
        return self._steps

    @functools.cached_property
    def _steps(self) -> np.ndarray:
        return load_steps(index_path(self.directory, self.split), self._index)

    def save_steps(self) -> None:
        save_steps(index_path(self.directory, self.split), self._index, self._steps)

    # --- episodes ----------------------------------------------------------------------------

    @contextmanager
    def open_episode(self, i: int, image_key: str, action_keys: Sequence[str]) -> Iterator[OpenEpisode]:
        """As `EpisodeSource.open_episode`. Raises CorruptRecordError, an EpisodeError, for damaged bytes."""
        self.check_keys(image_key, action_keys)
        image_key, action_keys = step_key(image_key), [step_key(k) for k in action_keys]
        fields = [field_slice(key)[0] for key in action_keys]
        with self._open(i, [image_key, *fields, SUCCESS_KEY]) as record:
            encoded = self._frames_of(i, record, image_key)
            actions = join_actions(
                record, action_keys, self.features, len(encoded), lambda what: self._unusable(i, what)
            )
            yield OpenEpisode(
                actions,
                find_success(record),
                lambda step: encoded[step],
                lambda step, data: self._image(i, image_key, step, data),
            )

    def frames(self, i: int, image_key: str, choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
        """As `EpisodeSource.frames`. A record is read and verified as a whole once, and the spans of its frames are
        cached. While they are, only the chosen frames are read, from a file that stays open (see `OpenFiles`).
        """
        key = step_key(image_key)
        known = self._span_cache.get((i, key))
        if known is not None:
            chosen = choose(len(known))
            path, offset, _ = self._locate(i)
            parts = read_parts(self._files.get(path), path, offset, known[chosen].tolist())
        else:
            self.check_keys(image_key, ())
            with self._open(i, [key]) as record:
                encoded = self._frames_of(i, record, key)
                chosen = choose(len(encoded))
                parts = [encoded[t] for t in chosen]
                if not self._in_array_records and not is_remote(self.directory):
                    self._span_cache.put((i, key), encoded.spans)
        return [self._image(i, key, t, data) for t, data in zip(chosen, parts, strict=True)]

    def record(self, i: int, keys: Sequence[str] | None = None) -> dict[str, Feature]:
        """The flat features of episode `i`, as `example.parse_example` gives them."""
        with self._open(i, keys, lazy=False) as record:
            return record

    # --- inside ------------------------------------------------------------------------------

    @contextmanager
    def _open(self, i: int, keys: Sequence[str] | None, lazy: bool = True) -> Iterator[dict[str, Feature]]:
        path, offset, length = self._locate(i)
        opened = array_record.open_record if self._in_array_records else open_record
        with opened(path, offset, length) as payload:
            yield parse_record(payload, path, offset, keys, lazy)

    def _check_shards(self, expected: Sequence[int]) -> None:
        """Raises DataError for missing, damaged or contradictory shards, or (under 'skip') counts their episodes as
        skipped."""
        for path, shard, count in zip(self._paths, self._index.shards, expected, strict=True):
            problem = None
            if shard.missing:
                problem = missing_shard(path)
            elif shard.damage:
                problem = CorruptRecordError(path, shard.damage_at, shard.damage)
            if problem is not None and self.corrupt == "raise":
                raise problem
            if shard.records == count:
                continue
            empty = "" if shard.size else ": the file is empty"
            message = (
                f"{path}: it has {shard.records} records, but dataset_info.json says {count}{empty}. Download the "
                "shard again, or restore the dataset_info.json it was written with."
            )
            if self.corrupt == "raise" or shard.records > count:
                raise DataError(message)
            self.count_skipped(str(problem or message), count - shard.records)
        if not len(self):
            why = without_advice(next(iter(self.skipped), "")) or self._said_empty()
            raise DataError(f"{self.directory}: split {self.split!r} has no readable episode: {why}")

    def _said_empty(self) -> str:
        splits = read_info(self.directory).splits.values()
        others = listing([split.name for split in splits if sum(split.shard_lengths)])
        return f"by dataset_info.json it is empty; splits with episodes: {others or 'none'}."

    def _locate(self, i: int) -> tuple[Location, int, int]:
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name}: episode {i} of {len(self)}")
        shard, _ = self._index.locate(i)
        return self._paths[shard], int(self._index.offsets[i]), int(self._index.lengths[i])

    def _unusable(self, i: int, what: str) -> EpisodeError:
        path, offset, _ = self._locate(i)
        shard, place = self._index.locate(i)
        number = sum(run.count for run in self.runs[:shard]) + place
        where = f"{self.name}, episode {number} ({path.name}, byte {offset})"
        return EpisodeError(f"{where}: {what}").at(path, offset)

    def _frames_of(self, i: int, record: dict[str, Feature], key: str) -> Sequence[bytes]:
        encoded = record.get(key, ())
        if not len(encoded):
            raise self._unusable(i, f"it has no frames in {key!r}; leave it out with corrupt='skip'")
        if isinstance(encoded, np.ndarray):
            raise self._unusable(i, f"{key!r} holds numbers, not images; leave it out with corrupt='skip'")
        self._steps[i] = len(encoded)
        return encoded

    def _image(self, i: int, key: str, step: int, data: bytes) -> np.ndarray:
        advice = "Repair the episode, or read with corrupt='skip'."
        return decode_frame(data, lambda what: self._unusable(i, f"step {step} of {key!r} {what}. {advice}"))
