"""A LeRobot dataset as an `EpisodeSource`: random access to its episodes, without a conversion.

Owns what `lerobot` leaves open: names, sizes and the fingerprint of episodes, and reading one frame at a time.
An episode is named by its `episode_index`.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.names import snake_case
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.lerobot import REWARD, SUCCESS, TASK, LeRobotSource
from data_pipelines.sources.lerobot_meta import EpisodeEntry, hash_episodes, hash_meta
from data_pipelines.sources.rlds.listing import list_files
from data_pipelines.sources.rlds.schema import field_slice, of_a_part, step_key
from data_pipelines.sources.source import (
    INSTRUCTION_KEY,
    MAX_SKIPPED,
    REWARD_KEY,
    SUCCESS_KEY,
    Corrupt,
    EpisodeSource,
    OpenEpisode,
    SourceFrame,
    decode_frame,
    join_actions,
)
from data_pipelines.sources.video import open_video
from hma_jax.config import require

LISTINGS = 16
"""Number of folders that are listed at a time."""


class LeRobotDataset(EpisodeSource):
    """Every episode of a LeRobot directory, versions 2.0, 2.1 and 3.0.

    Cameras are `observation/<name>`, numeric features `observation/<name>` and `action`, as the export
    to RLDS names them. Raises DataError for a directory of another layout, ConfigError for another
    split than train: the format has no others.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        *,
        corrupt: Corrupt = "raise",
        max_skipped: float = MAX_SKIPPED,
    ):
        super().__init__(corrupt, max_skipped)
        require(
            split == "train",
            f"{root}: no split {split!r}; a LeRobot dataset has only 'train': correct it where it was given, with --split "
            f"or in the dataset's registry entry.{of_a_part(split)}",
        )
        self.location, self.split = Path(root), split
        self.schema = self.location / "meta" / "info.json"
        self.name = lerobot_name(self.location)
        self._read = LeRobotSource(root, may_lose=corrupt == "skip")
        meta = self._read.meta
        self._entries, self.version = meta.episodes, meta.version
        self._cameras = {step_key(k): name for k, name in self._read.cameras.items()}
        self._vectors = {step_key(k): name for k, name in self._read.vectors.items()}
        self.features = self._read.layout.flat_features(self._read.unsupported_images)
        listed = np.asarray([e.index for e in self._entries], np.int64)
        if meta.lost_why:  # lost ones are named too: the hold-out of the others stays the same
            self.runs, self._numbers = (EpisodeRun("episodes", 0, meta.stated),), listed
            self.count_skipped(meta.lost_why, meta.stated - len(listed))
        else:
            self.runs, self._numbers = _runs(listed), np.arange(len(listed))
        self._lengths = np.asarray([e.length for e in self._entries], np.int64)
        self._paths = sorted({p for e in self._entries for p in (e.data, *(f for f, _ in e.videos.values()))})
        self.files = len(self._paths)
        self._bytes = _sizes(self._paths)

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def numbers(self) -> np.ndarray:
        return self._numbers

    @property
    def hz(self) -> float:
        return self._read.hz

    def fingerprint(self) -> str:
        """Hash over what is read from the meta folder, including statistics of single episodes, and over the names and
        sizes of all files. Texts and statistics of the whole dataset may change without changing it."""
        return self._fingerprint

    @functools.cached_property
    def _fingerprint(self) -> str:
        return self._with_sizes(hash_episodes(self.location, self._read.meta))

    def fingerprint_with_texts(self) -> str:
        """Hash over all files of the meta folder, and over the names and sizes of all others."""
        return self._with_sizes(hash_meta(self.location))

    def _with_sizes(self, digest: Any) -> str:
        for path, size in self._bytes.items():
            digest.update(f"{path.relative_to(self.location).as_posix()}:{size};".encode())
        return digest.hexdigest()[:16]

    def sizes(self) -> np.ndarray:
        """int64 [episodes]: each one's share of all files, by its length."""
        whole = sum(self._bytes.values())
        return np.maximum(self._lengths * whole // max(int(self._lengths.sum()), 1), 1)

    def steps(self) -> np.ndarray:
        return self._lengths.astype(np.int32)

    def open_episode(self, i: int, image_key: str, action_keys: Sequence[str]) -> AbstractContextManager[OpenEpisode]:
        return self._open(i, image_key, action_keys, with_success=self._read.layout.knows_success)

    def frames(self, i: int, image_key: str, choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
        """Like `EpisodeSource.frames`; frames of a video are read without the episode's table."""
        with self._open(i, image_key, (), with_success=False) as episode:
            return episode.images(choose)

    @contextmanager
    def _open(self, i: int, image_key: str, action_keys: Sequence[str], with_success: bool) -> Iterator[OpenEpisode]:
        self.check_keys(image_key, action_keys)
        camera, keys = step_key(image_key), [step_key(k) for k in action_keys]
        entry, where = self._entries[i], self._where(i)
        if not entry.length:
            what = f"{where}: the meta folder lists this episode with no steps; leave it out with corrupt='skip'."
            raise EpisodeError(what).at(entry.data, -1)
        with ExitStack() as stack:
            if not keys and not with_success and self._cameras[camera] in entry.videos:  # no table is needed
                steps, actions, success = entry.length, np.zeros((entry.length, 0), np.float32), None
                times = np.arange(steps) / self.hz
            else:
                fields = {field_slice(key)[0] for key in keys}
                table = self._table(i, [SUCCESS, *(self._vectors[f] for f in fields)])
                steps, times, success = table.num_rows, self._read.times(table, where), self._read.success(table, where)
                record = {f: self._read.numbers(table, self._vectors[f], where) for f in fields}
                actions = join_actions(
                    record, keys, self.features, steps, lambda what: EpisodeError(f"{where}: {what}").at(entry.data, -1)
                )
            fetch = self._fetch(stack, entry, self._cameras[camera], times, where)

            def decode(n: int, frame: SourceFrame) -> np.ndarray:
                advice = "Repair it, or read with corrupt='skip'."
                return decode_frame(frame, lambda what: EpisodeError(f"{where}, step {n} {what}. {advice}"))

            yield OpenEpisode(actions, success, fetch, decode)

    def record(self, i: int, keys: Sequence[str]) -> dict[str, Any]:
        where, entry = self._where(i), self._entries[i]
        table = self._table(i, [TASK, SUCCESS, REWARD, *(self._vectors[key] for key in keys if key in self._vectors)])
        times = self._read.times(table, where)
        found: dict[str, Any] = {}
        for key in keys:
            if key in self._vectors:
                found[key] = self._read.numbers(table, self._vectors[key], where).astype(np.float32).ravel()
            elif key in self._cameras:
                found[key] = _Frames(self, entry, self._cameras[key], times, where)
            elif key == INSTRUCTION_KEY:
                found[key] = [text.encode() for text in self._read.texts(entry, table, where)]
            elif key == SUCCESS_KEY and (success := self._read.success(table, where)) is not None:
                found[key] = np.array([success], np.int64)
            elif key == REWARD_KEY and REWARD in table.column_names:
                found[key] = self._read.numbers(table, REWARD, where)[:, 0].astype(np.float32)
        return found

    def _where(self, i: int) -> str:
        return f"{self.name}, episode {self._entries[i].index} ({self._entries[i].data.name})"

    def _table(self, i: int, columns: Sequence[str]) -> Any:
        entry = self._entries[i]
        table = self._read.rows(entry, columns)
        if table.num_rows != entry.length:
            raise EpisodeError(
                f"{self._where(i)} has {table.num_rows} rows, but the meta folder says {entry.length}. Download the "
                "dataset again, or leave the episode out with corrupt='skip'."
            ).at(entry.data, -1)
        return table

    def _fetch(
        self, stack: ExitStack, entry: EpisodeEntry, name: str, times: np.ndarray, where: str
    ) -> Callable[[int], SourceFrame]:
        """Frames of one camera while `stack` is open."""
        if name in entry.videos:
            path, begin = entry.videos[name]
            video = stack.enter_context(open_video(path, self._read.hz))
            return lambda n: video.at(float(times[n] + begin))
        return lambda n: self._read.image(entry, name, n, where)


class _Frames(Sequence[SourceFrame]):
    """The frames of one camera, each read on access. A video stays open from the first access until this object is
    garbage-collected, so that neighbouring frames are decoded in one pass. Not thread-safe."""

    def __init__(self, source: LeRobotDataset, entry: EpisodeEntry, *place: Any):
        self._source, self._entry, self._place, self._length = source, entry, place, entry.length
        self._fetch: Callable[[int], SourceFrame] | None = None
        self._open = ExitStack()
        weakref.finalize(self, self._open.close)
        self.nbytes = 0
        """Bytes read so far: whole row groups of a table, or the decoded pixels of a video."""

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, n: int) -> SourceFrame:
        before = self._source._read.loaded
        if self._fetch is None:
            self._fetch = self._source._fetch(self._open, self._entry, *self._place)
        frame = self._fetch(n)
        size = frame.nbytes if isinstance(frame, np.ndarray) else len(frame)
        self.nbytes += max(self._source._read.loaded - before, size)
        return frame


def lerobot_name(root: Path) -> str:
    """The directory's name as the name of a dataset. Raises DataError if no valid character is left of it.

    In the cache of the Hugging Face hub, `datasets--ORG--NAME/snapshots/REVISION`, it is NAME, whatever the revision.
    """
    repository, folder, own = ("", "", "", *root.absolute().parts)[-3:]
    if folder == "snapshots" and repository.startswith("datasets--"):
        own = repository.rpartition("--")[2]
    name = snake_case(own)
    if not name:
        raise DataError(
            f"{root}: a LeRobot dataset gets the name of its folder, but this name contains none of a to z and 0 to "
            "9. Rename the folder, or give a link to it with another name."
        )
    return name


def _runs(numbers: np.ndarray) -> tuple[EpisodeRun, ...]:
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 2) != 1)
    ends = [*starts[1:].tolist(), len(numbers)]
    return tuple(EpisodeRun("episodes", int(numbers[a]), b - a) for a, b in zip(starts.tolist(), ends, strict=True))


def _sizes(paths: Sequence[Path]) -> dict[Path, int]:
    """0 for a missing file: its episodes cannot be read, and reading them reports it. Whole folders are listed, since
    on a network drive asking for each file takes minutes."""
    folders = sorted({path.parent for path in paths})
    with ThreadPoolExecutor(LISTINGS, "sizes") as pool:
        listed = dict(zip(folders, pool.map(_list_folder, folders), strict=True))
    return {path: listed[path.parent].get(path.name, (0, ""))[0] for path in paths}


def _list_folder(folder: Path) -> dict[str, tuple[int, str]]:
    try:
        return list_files(folder)
    except FileNotFoundError:
        return {}
