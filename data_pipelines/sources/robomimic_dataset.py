"""A robomimic file as an `EpisodeSource`: random access to its demonstrations, without a conversion.

Owns what `robomimic` leaves open: names, sizes and the fingerprint of demonstrations, and reading a few frames at a
time. A demonstration is named by the file and its number.
"""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import EpisodeError
from data_pipelines.names import snake_case
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.rlds.schema import field_slice, step_key
from data_pipelines.sources.robomimic import RobomimicSource, damage_as, hdf5_path, holds_images, read_rows, succeeded
from data_pipelines.sources.settings import RobomimicSettings
from data_pipelines.sources.source import (
    INSTRUCTION_KEY,
    MAX_SKIPPED,
    REWARD_KEY,
    SUCCESS_KEY,
    Corrupt,
    EpisodeSource,
    OpenEpisode,
    SourceFrame,
    join_actions,
)

BLOCK = 16
"""Smallest number of frames to read at a time: files are often compressed in chunks of several."""


class RobomimicDataset(EpisodeSource):
    """The demonstrations of a robomimic HDF5 file: all of them as split `train`, or those of one mask or of several
    (`train+valid`).

    Raises DataError for a file of another layout or without images, ConfigError for an unknown mask.
    """

    def __init__(
        self,
        path: str | Path,
        split: str = "train",
        *,
        corrupt: Corrupt = "raise",
        max_skipped: float = MAX_SKIPPED,
    ):
        super().__init__(corrupt, max_skipped)
        self.location = self.schema = Path(path)
        self.split, self.version, self.files = split, "", 1
        self._read = RobomimicSource(path, RobomimicSettings(filter_key=None if split == "train" else split))
        self.name = robomimic_name(self._read.task)
        self._demos = list(self._read.units)
        self.features = self._read.layout.flat_features(self._read.unsupported_images)
        several = "+" in split
        self.runs = tuple(
            EpisodeRun(self.location.name, int(name.removeprefix("demo_")), 1, mask if several else "")
            for name, mask in self._read.masks.items()
        )
        with self._read.open() as file:
            self._lengths = np.asarray([self._length(file, i) for i in range(len(self._demos))], np.int32)
        self._bytes = self.location.stat().st_size

    def __len__(self) -> int:
        return len(self._demos)

    @property
    def hz(self) -> float | None:
        return self._read.recorded_hz  # None, not CONTROL_RATE, if the file does not say it

    def fingerprint(self) -> str:
        """Hash over the file's size and, for every demonstration, what `RobomimicSource.content` covers."""
        return hashlib.sha256(f"{self._bytes};{self._read.content}".encode()).hexdigest()[:16]

    def sizes(self) -> np.ndarray:
        """int64 [episodes]: each episode's share of the file's bytes, by its length."""
        lengths = np.maximum(self._lengths, 0).astype(np.int64)
        return np.maximum(lengths * self._bytes // max(int(lengths.sum()), 1), 1)

    def steps(self) -> np.ndarray:
        return self._lengths

    @contextmanager
    def open_episode(self, i: int, image_key: str, action_keys: Sequence[str]) -> Iterator[OpenEpisode]:
        self.check_keys(image_key, action_keys)
        camera, keys = step_key(image_key), [step_key(k) for k in action_keys]
        where = self._where(i)
        with self._read.open() as file:
            with damage_as(where):
                demo = file["data"][self._demos[i]]
                frames = _Frames(demo, _path(camera, self._read.ending), where)
                if not len(frames):
                    self._refuse(i, "a demonstration without steps")
                if "actions" in demo and len(frames) != len(demo["actions"]):
                    self._refuse(i, f"{len(frames)} frames of {camera!r} for {len(demo['actions'])} actions")
                fields = {field_slice(key)[0] for key in keys}
                record = {f: read_rows(demo, _path(f), where) for f in fields}
                success = self._success(demo, where)
            actions = join_actions(
                record, keys, self.features, len(frames),
                lambda what: EpisodeError(f"{where}: {what}").at(self.location, -1),
            )  # fmt: skip
            yield OpenEpisode(actions, success, frames.__getitem__, lambda n, data: data)

    def record(self, i: int, keys: Sequence[str]) -> dict[str, Any]:
        where, found = self._where(i), {}
        with self._read.open() as file, damage_as(where):
            demo = file["data"][self._demos[i]]
            for key in keys:
                if key in self.features and self.features[key].image:
                    if (path := _path(key, self._read.ending)) in demo:
                        found[key] = _LazyFrames(self, i, path, len(demo[path]))
                elif key in self.features:
                    if _path(key) in demo:
                        rows = read_rows(demo, _path(key), where).ravel()
                        found[key] = rows if rows.dtype.kind in "iu" else rows.astype(np.float32)
                elif key == INSTRUCTION_KEY:
                    found[key] = [self._read.text.encode()] * max(int(self._lengths[i]), 0)
                elif key == SUCCESS_KEY and (success := self._success(demo, where)) is not None:
                    found[key] = np.array([success], np.int64)
                elif key == REWARD_KEY and "rewards" in demo:
                    found[key] = read_rows(demo, "rewards", where).astype(np.float32)
        return found

    @contextmanager
    def _camera(self, i: int, path: str) -> Iterator[_Frames]:
        where = self._where(i)
        with self._read.open() as file:
            with damage_as(where):
                frames = _Frames(file["data"][self._demos[i]], path, where)
            yield frames

    def _length(self, file: Any, i: int) -> int:
        """Number of actions; -1 if there are none or they cannot be read: reading the episode then says why."""
        try:
            with damage_as(self._where(i)):
                demo = file["data"][self._demos[i]]
                return len(demo["actions"]) if "actions" in demo else -1
        except EpisodeError:
            return -1

    def _where(self, i: int) -> str:
        return f"{self.location}: data/{self._demos[i]}"

    def _refuse(self, i: int, what: str) -> None:
        raise EpisodeError(f"{self._where(i)}: {what}; leave it out with corrupt='skip'.").at(self.location, -1)

    def _success(self, demo: Any, where: str) -> bool | None:
        rewards, dones = (read_rows(demo, key, where) if key in demo else None for key in ("rewards", "dones"))
        return succeeded(rewards, dones)


class _Frames(Sequence[SourceFrame]):
    """Frames of one array of a demonstration, while its file is open. Not thread-safe."""

    def __init__(self, demo: Any, key: str, where: str):
        array = demo.get(key)
        if array is None or not holds_images(array):
            what = "is not there" if array is None else f"is {array.dtype} {list(array.shape)}"
            raise EpisodeError(
                f"{where}/{key} {what}; uint8 images [N, H, W, 3] were expected. Download the file again."
            )
        self._demo, self._key, self._where, self._length = demo, key, where, len(array)
        self._rows = max(array.chunks[0] if array.chunks else 1, BLOCK)
        self._at, self._block = -1, np.zeros((0, 0, 0, 3), np.uint8)
        self.nbytes = 0
        """Bytes read so far."""

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, n: int) -> np.ndarray:
        at = n // self._rows
        if at != self._at:
            rows = slice(at * self._rows, (at + 1) * self._rows)
            self._at, self._block = at, read_rows(self._demo, self._key, self._where, rows)
            self.nbytes += self._block.nbytes
        return self._block[n - at * self._rows].copy()  # a view would keep the whole block as long as the frame is used


class _LazyFrames(Sequence[SourceFrame]):
    """The frames of one camera, read on access. The file stays open from the first access until this object is
    garbage-collected, so that neighbouring frames are read together. Not thread-safe."""

    def __init__(self, source: RobomimicDataset, i: int, path: str, length: int):
        self._source, self._place, self._length = source, (i, path), length
        self._frames: _Frames | None = None
        self._open = ExitStack()
        weakref.finalize(self, self._open.close)

    @property
    def nbytes(self) -> int:
        """Bytes read so far."""
        return self._frames.nbytes if self._frames else 0

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, n: int) -> SourceFrame:
        if self._frames is None:
            self._frames = self._open.enter_context(self._source._camera(*self._place))
        return self._frames[n]


def robomimic_name(task: str) -> str:
    """`robomimic_<task>`, as names of datasets are written."""
    return snake_case(f"robomimic_{task}")


def _path(key: str, ending: str = "") -> str:
    """Where a field lies in a demonstration."""
    field = key.removeprefix("steps/")
    path = "actions" if field == "action" else hdf5_path(field)
    return path + ending
