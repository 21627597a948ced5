"""LeRobot datasets, versions 2.0, 2.1 and 3.0: parquet tables with videos or images.

Row t of an episode was recorded at t / fps seconds; its camera frame is the one that the video
shows at the row's timestamp (plus, in 3.0, the time at which the episode begins in its file).
Cameras become `observation/<name>`, other numeric features vectors: `observation/<name>`, `action`
or their own names; texts follow `task_index`. Success is the last `next.success`, where there is one. Depth and grey
cameras are not read; `unsupported_images` lists them with their shapes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError, UnreachableError, without_advice
from data_pipelines.names import quote, safe_join
from data_pipelines.sources.convertible import Episode, Layout, Skipped, UnitError, choose
from data_pipelines.sources.lerobot_meta import EpisodeEntry, hash_meta, read_meta
from data_pipelines.sources.parquet_rows import ParquetRows
from data_pipelines.sources.rlds.location import retry
from data_pipelines.sources.rlds.writer import STEP_FIELDS, encode_jpeg, image_field
from data_pipelines.sources.settings import LeRobotSettings
from data_pipelines.sources.video import ADVICE, open_video, shrink, stored_jpeg

PICTURES = ("video", "image")
NO_VECTORS = {"index", "episode_index", "frame_index", "task_index", "timestamp", *STEP_FIELDS}
"""Features that count rows, and names that steps use for something else."""

EPISODE, TIME, TASK, SUCCESS, REWARD = "episode_index", "timestamp", "task_index", "next.success", "next.reward"


class LeRobotSource:
    """Cameras go by their full or short name, `observation.images.top` or `top`.

    Raises DataError for a directory that is no such dataset and, unless `may_lose`, for episodes that the meta folder
    has lost; ConfigError for an unknown camera.
    """

    def __init__(self, root: str | Path, settings: LeRobotSettings = LeRobotSettings(), *, may_lose: bool = False):
        settings.check()
        self.root, self.short_side = Path(root), settings.short_side
        self.meta = read_meta(self.root)
        if self.meta.lost_why and not (may_lose and self.meta.may_lose):
            raise DataError(self.meta.lost_why)
        features = self.meta.features
        _check_names(features, self.root / "meta" / "info.json")
        available = {_short(key): key for key, feature in features.items() if _is_camera(feature)}
        others = {
            key: tuple(feature["shape"])
            for key, feature in features.items()
            if feature["dtype"] in PICTURES and not _is_camera(feature)
        }
        if not available:
            listed = ", ".join(f"{quote(key)}: {'x'.join(map(str, shape))}" for key, shape in others.items())
            found = f" (it has {listed}; write grey images with three channels)" if others else ""
            raise DataError(
                f"{self.root / 'meta' / 'info.json'}: no feature is a video or an image of 3 channels{found}."
            )
        wanted = [_short(camera) for camera in settings.camera]
        names = choose(wanted, tuple(available), "camera", str(self.root))
        self.cameras = {f"observation/{name}": available[name] for name in names}
        self.unsupported_images = {f"observation/{_short(key)}": shape for key, shape in others.items()}
        self.vectors = {_key(k): k for k, feature in features.items() if _is_vector(k, feature)}
        sizes = {key: int(np.prod(features[name]["shape"])) for key, name in self.vectors.items()}
        self.layout = Layout({k: image_field(None, None) for k in self.cameras}, sizes, SUCCESS in features)
        self.hz = self.meta.fps
        self.units = [f"episode {entry.index}" for entry in self.meta.episodes]
        self.description = f"LeRobot dataset {self.root.name} ({self.meta.version}), {self.hz:g} Hz."
        self._tables = ParquetRows(EPISODE)

    def identity(self) -> dict[str, Any]:
        files = {e.data for e in self.meta.episodes} | {f for e in self.meta.episodes for f, _ in e.videos.values()}
        sizes = {str(f.relative_to(self.root)): f.stat().st_size if f.exists() else -1 for f in sorted(files)}
        return {
            "root": self.root.name,
            "meta": hash_meta(self.root).hexdigest(),
            "files": sizes,
            "cameras": list(self.cameras),
            "short_side": self.short_side,
            "lost": self._lost,
        }

    @property
    def _lost(self) -> int:
        """Episodes that the meta folder should list but does not."""
        return self.meta.stated - len(self.units) if self.meta.lost_why else 0

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        if unit == 0:
            yield from [Skipped(without_advice(self.meta.lost_why))] * self._lost
        entry = self.meta.episodes[unit]
        where = f"{entry.data}: episode {entry.index}"
        table = self.rows(entry, [TASK, SUCCESS, REWARD, *self.vectors.values()])
        steps = table.num_rows
        if steps != entry.length:
            raise UnitError(f"{where} has {steps} rows, but the meta folder says {entry.length}. {ADVICE}")
        times = self.times(table, where)
        images = {key: self._images(entry, name, times, where) for key, name in self.cameras.items()}
        vectors = {key: self.numbers(table, name, where) for key, name in self.vectors.items()}
        has_reward = REWARD in table.column_names
        yield Episode(
            origin=f"{self.root.name}/episode_{entry.index:06d}",
            images=images,
            vectors=vectors,
            instructions=self.texts(entry, table, where),
            rewards=self.numbers(table, REWARD, where)[:, 0] if has_reward else None,
            success=self.success(table, where),
        )

    def rows(self, entry: EpisodeEntry, columns: Iterable[str]) -> Any:
        """The episode's rows, in order: their times, and those of `columns` that the file has."""
        with _as_units():
            first, count = self._locate(entry, columns := list(columns))
            available = self._tables.columns(entry.data)
            return self._tables.read(entry.data, [TIME, *(n for n in columns if n in available)], first, count)

    def image(self, entry: EpisodeEntry, camera: str, n: int, where: str) -> bytes:
        """Frame `n` of a camera whose images are in the table or in files that it names."""
        with _as_units():
            first, _ = self._locate(entry, ())
            self._check_camera(entry, camera, where)
            (value,) = self._tables.read(entry.data, [camera], first + n, 1)[camera].to_pylist()
        return self._image_bytes(value, f"{where}: {quote(camera)} at row {n}")

    @property
    def loaded(self) -> int:
        """Bytes of tables that were read so far; whole row groups are read."""
        return self._tables.loaded

    def _locate(self, entry: EpisodeEntry, columns: Sequence[str]) -> tuple[int, int]:
        """(first row, rows) in the episode's file, which must have those of `columns` that are vectors."""
        available, vectors = self._tables.columns(entry.data), {*self.vectors.values()}
        missing = [n for n in (EPISODE, TIME, *(c for c in columns if c in vectors)) if n not in available]
        if missing:
            raise UnitError(f"{entry.data}: no column {quote(missing[0])}. {ADVICE}")
        place = self._tables.find(entry.data, entry.index)
        if place is None:
            raise UnitError(f"{entry.data}: the rows of episode {entry.index} are missing or not contiguous. {ADVICE}")
        return place

    def _check_camera(self, entry: EpisodeEntry, name: str, where: str) -> None:
        if name not in self._tables.columns(entry.data):
            raise UnitError(f"{where} has no column {quote(name)}, but the feature is an image. {ADVICE}")

    def times(self, table: Any, where: str) -> np.ndarray:
        """Seconds since the episode's first frame. Raises UnitError for a row out of step."""
        times = self.numbers(table, TIME, where)[:, 0]
        expected = np.arange(len(times)) / self.hz
        wrong = np.flatnonzero(~(np.abs(times - expected) < 0.5 / self.hz))
        if len(wrong):
            row = int(wrong[0])
            raise UnitError(
                f"{where}: timestamp {times[row]:.4f} s at row {row}, but at {self.hz:g} frames per second it should "
                f"be {expected[row]:.4f} s. {ADVICE}"
            )
        return times

    def _images(self, entry: EpisodeEntry, name: str, times: np.ndarray, where: str) -> list[bytes]:
        if name in entry.videos:
            path, begin = entry.videos[name]
            with open_video(path, self.hz) as video:
                return [encode_jpeg(shrink(f, self.short_side)) for f in video.frames(times + begin)]
        self._check_camera(entry, name, where)
        images = []
        for row, value in enumerate(self.rows(entry, [name])[name].to_pylist()):
            here = f"{where}: {quote(name)} at row {row}"
            images.append(stored_jpeg(self._image_bytes(value, here), self.short_side, here))
        return images

    def _image_bytes(self, value: Any, where: str) -> bytes:
        """The bytes of an image, which lie in the table or in a file that it names."""
        if isinstance(value, dict) and value.get("bytes"):
            return value["bytes"]
        if isinstance(value, dict) and value.get("path"):
            try:
                path = safe_join(self.root, value["path"])
            except ValueError as error:
                raise UnitError(f"{where}: {error}. {ADVICE}") from error
            try:
                return retry(path, path.read_bytes)
            except FileNotFoundError as error:
                raise UnitError(f"{where}: {path} cannot be read ({error.strerror}). {ADVICE}") from error
        raise UnitError(f"{where} contains neither bytes nor a path. {ADVICE}")

    def numbers(self, table: Any, name: str, where: str) -> np.ndarray:
        """float64 [N, size] of a feature."""
        try:
            rows = np.asarray(table[name].to_pylist(), np.float64)
        except (TypeError, ValueError) as error:
            raise UnitError(
                f"{where}: {quote(name)} is not one array of numbers per row ({error}). {ADVICE}"
            ) from error
        return rows.reshape(len(rows), -1)

    def success(self, table: Any, where: str) -> bool | None:
        """Success as the episode's last row says; None if it does not say."""
        if SUCCESS not in table.column_names:
            return None
        last = self.numbers(table, SUCCESS, where)[-1]
        return bool(last.any()) if np.isfinite(last).all() else None

    def texts(self, entry: EpisodeEntry, table: Any, where: str) -> list[str]:
        if TASK not in table.column_names or not self.meta.tasks:
            return [entry.tasks[0] if entry.tasks else ""] * table.num_rows
        indices = table[TASK].to_pylist()
        unknown = [(row, i) for row, i in enumerate(indices) if type(i) is not int or i not in self.meta.tasks]
        if unknown:
            row, index = unknown[0]
            raise UnitError(f"{where}: task_index {quote(index)} at row {row} is not among the tasks of meta. {ADVICE}")
        return [self.meta.tasks[i] for i in indices]


@contextmanager
def _as_units() -> Iterator[None]:
    """A missing or damaged file counts as damage of the episode that is being read; a file that cannot be read does
    not."""
    try:
        yield
    except (UnreachableError, UnitError):
        raise
    except DataError as error:
        raise UnitError(str(error)) from error


def _is_camera(feature: dict[str, Any]) -> bool:
    depth = (feature.get("info") or feature.get("video_info") or {}).get("video.is_depth_map", False)
    return feature.get("dtype") in PICTURES and 3 in feature.get("shape", (3,)) and not depth


def _is_vector(key: str, feature: dict[str, Any]) -> bool:
    numeric = str(feature.get("dtype")).startswith(("float", "int", "uint", "bool"))
    return numeric and not key.startswith("next.") and _key(key) not in NO_VECTORS


def _check_names(features: Mapping[str, dict[str, Any]], path: Path) -> None:
    """Raises DataError for two features that would get the same name, so that one would hide the other."""
    named: dict[str, str] = {}
    for key, feature in features.items():
        if not _is_camera(feature) and not _is_vector(key, feature):
            continue
        name = f"observation/{_short(key)}" if _is_camera(feature) else _key(key)
        other = named.setdefault(name, key)
        if other != key:
            raise DataError(
                f"{path}: the features {quote(other)} and {quote(key)} would both be called {name!r}. "
                "Rename one of them."
            )


def _short(camera: str) -> str:
    return camera.removeprefix("observation.").removeprefix("images.").replace(".", "_")


def _key(feature: str) -> str:
    """`observation.state` -> `observation/state`, `action.arm` -> `action_arm`, `state` as it is."""
    name = feature.removeprefix("observation.").replace(".", "_").replace("/", "_")
    return f"observation/{name}" if feature.startswith("observation.") else name
