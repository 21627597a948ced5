"""What the `meta` folder of a LeRobot dataset says: features, rate, episodes and where they lie.

Owns the difference between the versions. 2.0 and 2.1: a parquet file and, per camera, a video
file for each episode; episodes and tasks are JSON lines. 3.0: several episodes per file, and
parquet tables that say in which file, and at what time of a video, each one begins.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError
from data_pipelines.json_file import read_object
from data_pipelines.sources.rlds.location import is_failure, retried
from data_pipelines.sources.units import require_module

VERSIONS = ("v2.0", "v2.1", "v3.0")
ADVICE = "Fetch the dataset again, meta folder included."


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode: its number, its length, its table, and per camera a video and where it begins."""

    index: int
    length: int
    data: Path
    videos: Mapping[str, tuple[Path, float]]  # feature -> (file, seconds)
    tasks: tuple[str, ...]


@dataclass(frozen=True)
class LeRobotMeta:
    """`features` as info.json has them; `tasks` by task_index."""

    version: str
    fps: float
    features: dict[str, dict[str, Any]]
    episodes: tuple[EpisodeEntry, ...]
    tasks: dict[int, str]


def read_meta(root: Path) -> LeRobotMeta:
    """Raises DataError, naming file and field, for what is missing, damaged or of another version."""
    info_path = root / "meta" / "info.json"
    info = _json(info_path)
    version = info.get("codebase_version")
    if version not in VERSIONS:
        raise DataError(
            f"{info_path}: codebase_version is {version!r}; {', '.join(VERSIONS)} can be read. Convert the "
            "dataset with LeRobot's own scripts first."
        )
    for field in ("fps", "features", "data_path"):
        if not info.get(field):
            raise DataError(f"{info_path}: no {field!r}. {ADVICE}")
    features = info["features"]
    videos = [key for key, feature in features.items() if feature.get("dtype") == "video"]
    if videos and not info.get("video_path"):
        raise DataError(f"{info_path}: no 'video_path', but {videos[0]!r} is a video. {ADVICE}")
    read = _episodes_3 if version == "v3.0" else _episodes_2
    episodes = read(root, info, videos)
    if not episodes:
        raise DataError(f"{root / 'meta'}: no episode is listed. {ADVICE}")
    return LeRobotMeta(version, float(info["fps"]), features, tuple(episodes), _tasks(root, version))


def _episodes_2(root: Path, info: dict[str, Any], videos: list[str]) -> list[EpisodeEntry]:
    path, chunk_size = root / "meta" / "episodes.jsonl", int(info.get("chunks_size") or 1000)
    entries = []
    for line, row in enumerate(_json_lines(path), 1):
        try:
            index, length = int(row["episode_index"]), int(row["length"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: line {line} has no usable {error}. {ADVICE}") from error
        place = {"episode_chunk": index // chunk_size, "episode_index": index}
        clips = {k: (root / _fill(info, "video_path", video_key=k, **place), 0.0) for k in videos}
        tasks = tuple(map(str, row.get("tasks") or ()))
        entries.append(EpisodeEntry(index, length, root / _fill(info, "data_path", **place), clips, tasks))
    return sorted(entries, key=lambda e: e.index)


def _episodes_3(root: Path, info: dict[str, Any], videos: list[str]) -> list[EpisodeEntry]:
    folder = root / "meta" / "episodes"
    places = {k: [f"videos/{k}/{f}" for f in ("chunk_index", "file_index", "from_timestamp")] for k in videos}
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    columns += [column for group in places.values() for column in group]
    entries = []
    for path in sorted(folder.glob("*/*.parquet")):
        table = read_table(path)
        missing = [c for c in columns if c not in table.column_names]
        if missing:
            raise DataError(f"{path}: no column {missing[0]!r}. {ADVICE}")
        wanted = [*columns, *(["tasks"] if "tasks" in table.column_names else [])]
        for line, row in enumerate(table.select(wanted).to_pylist()):
            empty = [c for c in columns if row[c] is None]
            if empty:
                raise DataError(f"{path}: row {line} has no {empty[0]!r}. {ADVICE}")
            clips = {}
            for key, (chunk, file, begin) in places.items():
                name = _fill(info, "video_path", video_key=key, chunk_index=row[chunk], file_index=row[file])
                clips[key] = (root / name, float(row[begin]))
            place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
            data = root / _fill(info, "data_path", **place)
            tasks = tuple(map(str, row.get("tasks") or ()))
            entries.append(EpisodeEntry(row["episode_index"], row["length"], data, clips, tasks))
    return sorted(entries, key=lambda e: e.index)


def _tasks(root: Path, version: str) -> dict[int, str]:
    if version != "v3.0":
        path = root / "meta" / "tasks.jsonl"
        rows = _json_lines(path) if path.exists() else []
        return {
            int(row["task_index"]): str(row["task"]) for row in rows if "task_index" in row and "task" in row
        }
    path = root / "meta" / "tasks.parquet"
    if not path.exists():
        return {}
    table = read_table(path)
    # pandas stores the tasks as the index, which has had several names.
    text = [c for c in ("task", "__index_level_0__", "index") if c in table.column_names]
    if not text or "task_index" not in table.column_names:
        raise DataError(
            f"{path}: the columns are {', '.join(table.column_names)}; task and task_index are needed."
        )
    return dict(zip(table["task_index"].to_pylist(), map(str, table[text[0]].to_pylist()), strict=True))


def read_table(path: Path, columns: list[str] | None = None, **options: Any) -> Any:
    """A pyarrow table. Raises DataError for a file that is missing or damaged."""
    parquet, arrow = require_module("pyarrow.parquet"), require_module("pyarrow")

    def read() -> Any:
        try:
            return parquet.read_table(path, columns=columns, partitioning=None, **options)
        except (OSError, arrow.ArrowException) as error:
            if is_failure(error):
                raise  # to be tried again
            raise DataError(f"{path}: the table cannot be read ({str(error).strip()}). {ADVICE}") from error

    return retried(path, read)


def _fill(info: dict[str, Any], field: str, **place: Any) -> str:
    try:
        return info[field].format(**place)
    except (KeyError, ValueError, IndexError) as error:
        raise DataError(
            f"meta/info.json: {field} {info[field]!r} cannot be filled in ({error}). {ADVICE}"
        ) from error


def _json(path: Path) -> dict[str, Any]:
    missing = "give the root of a LeRobot dataset, with meta, data and videos."
    return read_object(path, if_missing=missing, advice=ADVICE)


def _json_lines(path: Path) -> list[dict[str, Any]]:
    try:
        return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}). {ADVICE}") from error
