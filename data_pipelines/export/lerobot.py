"""Writes any source as a LeRobot dataset, version 3.0, resumable after every file.

A file holds some episodes: their rows (`data`), the frames of each camera (`videos`), and last the table that lists
them (`meta/episodes`). A file without that table is unfinished, and is written again. Until the last file is finished,
all are in a hidden directory beside the dataset. `data_pipelines.sources.lerobot_meta` reads what is written here.
"""

from __future__ import annotations

import glob
import itertools
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipelines.errors import DataError, EpisodeError, without_advice
from data_pipelines.export.fields import ACTION, STATE, LeRobotFields
from data_pipelines.export.statistics import COMBINED, combine, of_values, quantiles
from data_pipelines.export.tables import INDEXED_BY_TASK, arrow, arrow_type, vectors, write_table
from data_pipelines.export.video import VideoWriter, pixel_format
from data_pipelines.json_file import read_object
from data_pipelines.publishing.files import publish, sync
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.sources.convertible import require_module
from data_pipelines.sources.lerobot import EPISODE, REWARD, SUCCESS, TASK, TIME
from data_pipelines.sources.rlds.schema import field_slice
from data_pipelines.sources.source import (
    INSTRUCTION_KEYS,
    REWARD_KEY,
    SUCCESS_KEY,
    EpisodeSource,
    SourceFrame,
    decode_frame,
    find_instructions,
    find_success,
    join_actions,
)
from hma_jax.config import require
from hma_jax.config.json import stable_hash, to_strict_json
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    import pyarrow as pa

EXPORTER_VERSION = 2
"""Raise it when other files are written for the same source."""

FILE_BYTES = 2**31
"""A file ends with the episode whose pixels, before they are compressed, reach this size: a minute of work or two."""

FRAME_BYTES = 2**16
"""A smaller frame counts as one of this size, since it takes as long to write."""

CHUNK = 1000
"""Files in a folder."""

FILE_SIZES = {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
"""LeRobot's own defaults, up to which its tools fill files when they edit the dataset."""

FRAME, INDEX, DONE, END = "frame_index", "index", "next.done", "dataset_to_index"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
ORIGIN = "meta/origin.json"
NUMBER = "source_episode"
"""Column of `meta/episodes`: the episode's number in the source."""

Progress = Callable[[int, int, str], None]
"""Called with (episodes of the source that were read, of how many, a note)."""


@dataclass(frozen=True)
class Exported:
    """What a finished export wrote: episodes, frames, and how many episodes of the source were left out."""

    episodes: int
    frames: int
    left_out: int


def export_lerobot(
    source: EpisodeSource,
    fields: LeRobotFields,
    out: str | Path,
    hz: float,
    *,
    file_bytes: int = FILE_BYTES,
    progress: Progress | None = None,
) -> Exported:
    """Writes every episode of `source` into the new directory `out`; `hz`: frames per second.

    With the same source and settings again it resumes, or returns at once if the dataset is finished. Damaged episodes
    are left out if `source` was opened with corrupt='skip'; otherwise they raise EpisodeError. Raises DataError if no
    episode is left, ConfigError if PyAV is missing and for a directory that exists and is another dataset.
    """
    require(0 < hz < math.inf, f"frames per second must be positive and finite, got {hz}")
    final = Path(out).absolute()
    settings = {
        "exporter": EXPORTER_VERSION,
        "source": source.name,
        "split": source.split,
        "contents": source.fingerprint(),
        "vectors": {name: list(keys) for name, keys in fields.vectors.items()},
        "cameras": dict(fields.cameras),
        "hz": hz,
        "file_bytes": file_bytes,
    }
    if final.exists():
        return _finished(final, settings)
    require_module("av", "writing videos")
    with lock_output(final):
        if final.exists():  # another process has made it meanwhile
            return _finished(final, settings)
        partial = final.with_name(_partial(final.name, stable_hash(settings)[:16]))
        writer = _Writer(source, fields, partial, hz)
        writer.write(file_bytes, progress)
        writer.finish(settings)
        publish(partial, final)
        for other in final.parent.glob(_partial(glob.escape(final.name), "[0-9a-f]" * 16)):
            shutil.rmtree(other, ignore_errors=True)  # begun with other settings, so nothing can finish it any more
        return _finished(final, settings)


def _partial(name: str, settings: str) -> str:
    """The name of the directory in which the dataset `name` is made, with the hash of its `settings`."""
    return f".{name}.{settings}.partial"


def _finished(final: Path, settings: Mapping[str, Any]) -> Exported:
    """The result of an earlier run, if it wrote the same dataset; ConfigError otherwise."""
    path, other = final / ORIGIN, "choose another --out, or remove it"
    require(path.is_file(), f"{final} exists already and was not made by this command; {other}")
    origin = read_object(path, if_missing=f"{path} is missing.", advice="Remove the dataset.")
    require(
        origin["settings"] == settings,
        f"{final} exists already and was made from another dataset or with other settings; {other}",
    )
    return Exported(origin["episodes"], origin["frames"], origin["left_out"])


@dataclass(frozen=True)
class _Episode:
    """One episode of N steps, with its frames still encoded."""

    number: int  # in the source
    columns: dict[str, np.ndarray]  # feature -> [N, size]
    frames: dict[str, Sequence[SourceFrame]]  # camera -> N
    texts: list[str]


class _Writer:
    """One export: what is finished already, and the next files."""

    def __init__(self, source: EpisodeSource, fields: LeRobotFields, root: Path, hz: float):
        self._source, self._fields, self._root, self._hz = source, fields, root, hz
        listed = [row for table in self._listed(EPISODE, "tasks", NUMBER, END) for row in table.to_pylist()]
        self._episodes, self._files = len(listed), sum(1 for _ in self._tables())
        self._frames, self._following = (listed[-1][END], listed[-1][NUMBER] + 1) if listed else (0, 0)
        written = {row[NUMBER] for row in listed}
        for i in range(self._following):
            if i not in written:
                source.skip(i, EpisodeError(f"{source.name}, episode {i}: it was left out before the interruption."))
        self._tasks = {text: i for i, text in enumerate(dict.fromkeys(text for row in listed for text in row["tasks"]))}
        self._shapes: dict[str, tuple[int, ...]] = {}  # camera -> shape of its frames
        self._dtypes: dict[str, str] = {}
        if listed:  # the first episode determines the columns of all, and the sizes of frames
            self._read(listed[0][NUMBER])

    def _tables(self) -> Iterator[Path]:
        """The tables of finished files."""
        for number in itertools.count():
            path = self._root / EPISODES.format(**_place(number))
            if not path.exists():
                return
            yield path

    def _listed(self, *columns: str) -> Iterator[pa.Table]:
        """Columns of the tables of finished files."""
        import pyarrow.parquet as pq

        return (pq.read_table(path, columns=list(columns)) for path in self._tables())

    # --- reading ---------------------------------------------------------------------------------

    def _read(self, i: int) -> _Episode:
        """Episode `i` of the source. Raises EpisodeError for a damaged one."""
        keys = [part.partition("[")[0] for keys in self._fields.vectors.values() for part in keys]
        record = self._source.record(
            i, [*self._fields.cameras.values(), *keys, *INSTRUCTION_KEYS, REWARD_KEY, SUCCESS_KEY]
        )

        def unusable(what: str) -> EpisodeError:
            return EpisodeError(f"{self._source.name}, episode {i}: {what}")

        frames = {name: record.get(key, ()) for name, key in self._fields.cameras.items()}
        steps = len(next(iter(frames.values())))
        if not steps:
            raise unusable("it has no frames.")
        for name, of in frames.items():
            if len(of) != steps or isinstance(of, np.ndarray):
                raise unusable(f"{self._fields.cameras[name]!r} has {len(of)} frames of {steps}.")
        columns = {name: self._vector(name, record, steps, unusable) for name in self._fields.vectors}
        if REWARD_KEY in record:
            rewards = np.asarray(record[REWARD_KEY], np.float32).reshape(-1, 1)
            if len(rewards) != steps or not np.isfinite(rewards).all():
                raise unusable(f"it has no finite reward for each of its {steps} steps.")
            columns[REWARD] = rewards
        last = (np.arange(steps) == steps - 1)[:, None]
        columns[DONE] = last
        if (success := find_success(record)) is not None:
            columns[SUCCESS] = last & success
        columns[FRAME] = np.arange(steps)[:, None]
        columns[TIME] = (columns[FRAME] / self._hz).astype(np.float32)
        dtypes = {name: values.dtype.name for name, values in columns.items()}
        if lacking := dtypes.keys() ^ (self._dtypes or dtypes).keys():
            raise unusable(f"it differs from the first one: only one of them has {', '.join(sorted(lacking))}.")
        # Every frame is decoded here, before anything of the episode is written.
        shapes = {name: self._shape(name, of, unusable) for name, of in frames.items()}
        self._dtypes, self._shapes = dtypes, shapes
        return _Episode(i, columns, frames, find_instructions(record, steps))

    def _vector(
        self, name: str, record: Mapping[str, Any], steps: int, unusable: Callable[[str], EpisodeError]
    ) -> np.ndarray:
        """[steps, size]: float32, or int64 if all its fields are integers, such as clocks, which float32 would round.
        Policies take an action and a state as float32."""
        keys = self._fields.vectors[name]
        joined = join_actions(record, keys, self._source.features, steps, unusable)
        parts = [(record[field], part) for field, part in map(field_slice, keys)]
        if name in (ACTION, STATE) or any(values.dtype.kind not in "iu" for values, _ in parts):
            return joined
        return np.concatenate([values.reshape(steps, -1)[:, part] for values, part in parts], axis=1).astype(np.int64)

    def _shape(
        self, camera: str, frames: Sequence[SourceFrame], unusable: Callable[[str], EpisodeError]
    ) -> tuple[int, ...]:
        """(H, W, 3) of every frame, in this episode and those before."""
        shape = self._shapes.get(camera)
        for step, frame in enumerate(frames):
            found = decode_frame(frame, lambda what, step=step: unusable(f"step {step} of {camera!r} {what}.")).shape
            shape = shape or found
            if found != shape:
                sizes = " and ".join(f"{height} x {width}" for height, width, _ in (shape, found))
                raise unusable(f"frames of {camera!r} have two sizes ({sizes}), but a LeRobot video has one.")
        return shape

    # --- writing ---------------------------------------------------------------------------------

    def write(self, file_bytes: int, progress: Progress | None) -> None:
        """All files that are not finished."""
        while self._following < len(self._source):
            self._write_file(self._next_episodes(file_bytes, progress))

    def _next_episodes(self, file_bytes: int, progress: Progress | None) -> Iterator[_Episode]:
        size, total = 0, len(self._source)
        while self._following < total and size < file_bytes:
            try:
                episode = self._read(self._following)
            except EpisodeError as error:
                self._source.skip(self._following, error)
            else:
                sizes = {name: max(math.prod(shape), FRAME_BYTES) for name, shape in self._shapes.items()}
                size += sum(len(of) * sizes[name] for name, of in episode.frames.items())
                yield episode
            self._following += 1
            if progress is not None:
                progress(self._following, total, "")

    def _write_file(self, episodes: Iterator[_Episode]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        place = _place(self._files)
        data, rows, begin = self._root / DATA.format(**place), [], self._frames
        videos = {
            name: VideoWriter(self._root / VIDEO.format(video_key=name, **place), self._hz)
            for name in self._fields.cameras
        }
        with ExitStack() as stack:
            writer = None
            for episode in episodes:
                index, steps, start = self._episodes + len(rows), len(episode.texts), self._frames
                columns = {
                    **episode.columns,
                    EPISODE: np.full((steps, 1), index),
                    INDEX: start + np.arange(steps)[:, None],
                    TASK: np.array([[self._tasks.setdefault(t, len(self._tasks))] for t in episode.texts]),
                }
                if writer is None:
                    data.parent.mkdir(parents=True, exist_ok=True)
                    schema = pa.schema([(name, arrow_type(values)) for name, values in columns.items()])
                    writer = stack.enter_context(pq.ParquetWriter(data, schema))
                    for video in videos.values():
                        stack.enter_context(video)
                writer.write_table(pa.table([arrow(values) for values in columns.values()], schema=schema))
                found = {name: of_values(values) for name, values in columns.items()}
                found |= {camera: videos[camera].add(frames) for camera, frames in episode.frames.items()}
                shown = (start - begin) / self._hz, (start - begin + steps) / self._hz
                rows.append({
                    EPISODE: index, "tasks": list(dict.fromkeys(episode.texts)), "length": steps, NUMBER: episode.number,
                    "dataset_from_index": start, END: start + steps,
                    **_named("data", place), **_named("meta/episodes", place),
                    **{key: value for camera in videos for key, value in _named(f"videos/{camera}", {
                        **place, "from_timestamp": shown[0], "to_timestamp": shown[1]
                    }).items()},
                    **{f"stats/{name}/{key}": value.tolist() for name, of in found.items() for key, value in of.items()},
                })  # fmt: skip
                self._frames += steps
        if not rows:  # the last episodes of the source are all damaged
            return
        for path in (data, *(video.path for video in videos.values())):
            sync(path)
        write_table(self._root / EPISODES.format(**place), pa.Table.from_pylist(rows))
        self._episodes, self._files = self._episodes + len(rows), self._files + 1

    def finish(self, settings: Mapping[str, Any]) -> None:
        """The files on all episodes. Raises DataError if there is none."""
        if not self._episodes:
            why = without_advice(next(iter(self._source.skipped), "it has none"))
            raise DataError(f"{self._source.location}: no episode can be written: {why}")
        import pyarrow as pa

        features = self._features()
        info = {
            "codebase_version": "v3.0",
            "robot_type": self._source.name,
            "total_episodes": self._episodes,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            **FILE_SIZES,
            "fps": int(self._hz) if float(self._hz).is_integer() else self._hz,
            "splits": {"train": f"0:{self._episodes}"},
            "data_path": DATA,
            "video_path": VIDEO,
            "features": features,
        }
        meta = self._root / "meta"
        tasks = pa.table({"task_index": range(len(self._tasks)), "task": list(self._tasks)})
        write_table(meta / "tasks.parquet", tasks.replace_schema_metadata({"pandas": INDEXED_BY_TASK}))
        write_file(meta / "stats.json", to_strict_json({name: self._statistics(name) for name in features}))
        write_file(meta / "info.json", to_strict_json(info))
        left_out = sum(run.count for run in self._source.runs) - self._episodes
        for stray in self._root.rglob(".*.tmp"):  # left by killed exports
            stray.unlink()
        origin = {"settings": settings, "episodes": self._episodes, "frames": self._frames, "left_out": left_out}
        write_file(self._root / ORIGIN, to_strict_json(origin))

    def _features(self) -> dict[str, Any]:
        sizes = {name: len(of) for name, of in self._fields.names.items()}
        plain = {**self._dtypes, **dict.fromkeys((EPISODE, INDEX, TASK), "int64")}
        features = {
            name: {
                "dtype": dtype,
                "shape": [sizes.get(name, 1)],
                "names": list(self._fields.names.get(name, ())) or None,
            }
            for name, dtype in plain.items()
        }
        for camera, (height, width, channels) in self._shapes.items():
            about = {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": pixel_format(height, width),
                "video.fps": self._hz,
                "video.channels": channels,
                "video.is_depth_map": False,
                "has_audio": False,
            }
            names = ["height", "width", "channels"]
            features[camera] = {"dtype": "video", "shape": [height, width, channels], "names": names, "info": about}
        return features

    def _statistics(self, feature: str) -> dict[str, Any]:
        """Statistics of the whole dataset; the quantiles of a vector are those of all its rows."""
        import pyarrow.parquet as pq

        keys = {key: f"stats/{feature}/{key}" for key in COMBINED}
        rows = [row for table in self._listed(*keys.values()) for row in table.to_pylist()]
        found = dict(combine([{key: np.asarray(row[column]) for key, column in keys.items()} for row in rows]))
        if feature in self._fields.vectors:
            files = (self._root / DATA.format(**_place(number)) for number in range(self._files))
            found |= quantiles(np.concatenate([vectors(pq.read_table(f, columns=[feature])[feature]) for f in files]))
        return {key: value.tolist() for key, value in found.items()}


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK, "file_index": number % CHUNK}


def _named(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{prefix}/{key}": value for key, value in values.items()}
