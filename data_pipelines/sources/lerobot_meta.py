"""Reading the `meta` folder of a LeRobot dataset: features, rate, and the files of each episode.

Owns the differences between the versions. 2.0 and 2.1: a parquet file and, per camera, a video
file for each episode; episodes and tasks are JSON lines. 3.0: several episodes per file, and
parquet tables that say in which file, and at what time of a video, each one begins.
"""

from __future__ import annotations

import functools
import hashlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError
from data_pipelines.json_file import read_lines, read_object
from data_pipelines.names import quote, safe_join
from data_pipelines.sources.parquet_rows import ADVICE, read_table
from data_pipelines.sources.rlds.location import retry
from hma_jax.runtime.files import hash_file

VERSIONS = ("v2.0", "v2.1", "v3.0")

MAX_COUNT = 10**9
"""Largest accepted episode index, episode length, chunk or task index, and number of values of a feature."""

MAX_LOST = 10**6
"""How many episodes may be missing from the list: each is named, in 8 bytes, so that the others keep their place in or
out of the hold-out."""


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode: its number, its length, its table, and for each camera a video and the time at which the episode
    begins."""

    index: int
    length: int
    data: Path
    videos: Mapping[str, tuple[Path, float]]  # feature -> (file, seconds)
    tasks: tuple[str, ...]


@dataclass(frozen=True, eq=False)  # as a key it is itself: `read_meta` gives the same one while no file changes
class LeRobotMeta:
    """`features` as info.json has them; `tasks` by task_index.

    `stated`: the number of episodes according to info.json. `lost_why`: the message if fewer are listed, else "".
    `may_lose`: whether the listed numbers show which ones are lost, and these are at most MAX_LOST.
    """

    version: str
    fps: float
    features: dict[str, dict[str, Any]]
    episodes: tuple[EpisodeEntry, ...]
    tasks: dict[int, str]
    stated: int
    lost_why: str
    may_lose: bool


def read_info(root: Path) -> dict[str, Any]:
    """info.json. Raises DataError, naming the field, for what is missing, damaged or of another version."""
    info_path = root / "meta" / "info.json"
    missing = "give the root of a LeRobot dataset, with meta, data and videos."
    info = read_object(info_path, if_missing=missing, advice=ADVICE)
    version = info.get("codebase_version")
    if version not in VERSIONS:
        raise DataError(
            f"{info_path}: codebase_version is {quote(version)}; only {', '.join(VERSIONS)} can be read. Convert the "
            "dataset with LeRobot's own scripts first."
        )
    for field in ("fps", "features", "data_path"):
        if not info.get(field):
            raise DataError(f"{info_path}: no {field!r}. {ADVICE}")
    _check_info(info, info_path)
    return info


def read_meta(root: Path) -> LeRobotMeta:
    """Reads the meta folder. Raises DataError, naming file and field, for what is missing, damaged or of another
    version. The result is cached until a file of the folder changes: a command opens a dataset several times."""
    files = retry(root, lambda: [(p, p.stat()) for p in sorted((root / "meta").rglob("*")) if p.is_file()])
    return _read_meta(root, tuple((path, stat.st_mtime_ns, stat.st_size) for path, stat in files))


@functools.lru_cache(8)
def _read_meta(root: Path, stamp: tuple[tuple[Path, int, int], ...]) -> LeRobotMeta:
    info_path, info = root / "meta" / "info.json", read_info(root)
    version, features = info["codebase_version"], info["features"]
    videos = [key for key, feature in features.items() if feature.get("dtype") == "video"]
    if videos and not info.get("video_path"):
        raise DataError(f"{info_path}: 'video_path' is missing, but {quote(videos[0])} is a video. {ADVICE}")
    read = _episodes_3 if version == "v3.0" else _episodes_2
    episodes = read(root, info, videos)
    if not episodes:
        raise DataError(f"{root / 'meta'}: no episode is listed. {ADVICE}")
    for one, following in pairwise(episodes):
        if one.index == following.index:
            raise DataError(
                f"{root / 'meta'}: episode {one.index} is listed twice, as happens when recording was resumed. Remove "
                "one of the two lines, or download the dataset again."
            )
    _check_range(info.get("splits") or {}, episodes, info_path)
    stated, lost_why = info.get("total_episodes") or 0, ""
    may_lose = episodes[-1].index < stated <= len(episodes) + MAX_LOST
    if len(episodes) < stated:
        absent = next((n for n, e in enumerate(episodes) if e.index != n), len(episodes))
        lost_why = (
            f"{root / 'meta'}: it lists {len(episodes)} episodes, without episode {absent}, but total_episodes in "
            f"info.json is {stated}. Download the meta folder again"
            + (", or leave them out with --set store.corrupt=skip (`hma data convert`: --skip-damaged)" * may_lose)
            + f", or write {len(episodes)} there if they were removed on purpose, which changes what is held out."
        )
    tasks = _tasks(root, version)
    return LeRobotMeta(version, float(info["fps"]), features, tuple(episodes), tasks, stated, lost_why, may_lose)


def hash_meta(root: Path) -> hashlib._Hash:
    """SHA-256, to which more can be added, of the names and contents of all files of the meta folder.

    Hidden ones are left out: file managers and editors write them (.DS_Store, .info.json.swp).
    """
    digest, meta = hashlib.sha256(), root / "meta"
    for path in sorted(p for p in meta.rglob("*") if p.is_file()):
        name = path.relative_to(meta).as_posix()
        if not any(part.startswith(".") for part in name.split("/")):
            digest.update(f"{name}:{retry(path, functools.partial(hash_file, path))};".encode())
    return digest


def hash_episodes(root: Path, meta: LeRobotMeta) -> hashlib._Hash:
    """SHA-256, to which more can be added, of what is read from the meta folder: the rate, the features, and for every
    episode its place, length and statistics. No reader needs the statistics, but they change with the episode's actions
    and images. If single episodes have none, those of the whole dataset are used."""
    return _hash_episodes(root, meta).copy()


@functools.lru_cache(8)  # statistics of a million episodes take minutes
def _hash_episodes(root: Path, meta: LeRobotMeta) -> hashlib._Hash:
    def place(path: Path) -> str:
        return path.relative_to(root).as_posix()

    shapes = {name: (feature["dtype"], feature["shape"]) for name, feature in sorted(meta.features.items())}
    digest = hashlib.sha256(repr((meta.version, meta.fps, shapes, meta.stated)).encode())
    for e in meta.episodes:
        videos = {name: (place(path), begin) for name, (path, begin) in sorted(e.videos.items())}
        digest.update(repr((e.index, e.length, place(e.data), videos)).encode())
    names = [f"stats/{name}/{value}" for name in shapes for value in ("min", "max", "mean", "std")]
    known = False
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):  # 3.0
        table = read_table(path, names)
        columns = [(name, table[name].to_pylist()) for name in names if name in table.column_names]
        digest.update(repr(columns).encode())
        known |= bool(columns)
    of_episodes = root / "meta" / "episodes_stats.jsonl"  # 2.1
    statistics = of_episodes if known or of_episodes.exists() else root / "meta" / "stats.json"
    if statistics.exists():
        digest.update(retry(statistics, functools.partial(hash_file, statistics)).encode())
    return digest


def _episodes_2(root: Path, info: dict[str, Any], videos: list[str]) -> list[EpisodeEntry]:
    path, chunk_size = root / "meta" / "episodes.jsonl", info.get("chunks_size") or 1000
    entries = []
    for line, row in _json_lines(path):
        index, length = (_count(row, name, f"{path}: line {line}") for name in ("episode_index", "length"))
        values = {"episode_chunk": index // chunk_size, "episode_index": index}
        clips = {k: (_format_path(root, info, "video_path", video_key=k, **values), 0.0) for k in videos}
        tasks = _texts(row, f"{path}: line {line}")
        entries.append(EpisodeEntry(index, length, _format_path(root, info, "data_path", **values), clips, tasks))
    return sorted(entries, key=lambda e: e.index)


def _episodes_3(root: Path, info: dict[str, Any], videos: list[str]) -> list[EpisodeEntry]:
    folder = root / "meta" / "episodes"
    fields = {k: [f"videos/{k}/{f}" for f in ("chunk_index", "file_index", "from_timestamp")] for k in videos}
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    columns += [column for group in fields.values() for column in group]
    entries = []
    for path in sorted(folder.glob("*/*.parquet")):
        table = read_table(path, [*columns, "tasks"])  # the same tables hold statistics, which take far more memory
        missing = [c for c in columns if c not in table.column_names]
        if missing:
            raise DataError(f"{path}: no column {quote(missing[0])}. {ADVICE}")
        for line, row in enumerate(_rows(table, path)):
            where = f"{path}: row {line}"
            number = {c: (_seconds if c.endswith("timestamp") else _count)(row, c, where) for c in columns}
            clips = {}
            for key, (chunk, file, begin) in fields.items():
                values = {"chunk_index": number[chunk], "file_index": number[file]}
                clips[key] = (_format_path(root, info, "video_path", video_key=key, **values), number[begin])
            values = {"chunk_index": number["data/chunk_index"], "file_index": number["data/file_index"]}
            data = _format_path(root, info, "data_path", **values)
            tasks = _texts(row, where)
            entries.append(EpisodeEntry(number["episode_index"], number["length"], data, clips, tasks))
    return sorted(entries, key=lambda e: e.index)


def _tasks(root: Path, version: str) -> dict[int, str]:
    if version != "v3.0":
        path = root / "meta" / "tasks.jsonl"
        rows = _json_lines(path) if path.exists() else []
        return {
            _count(row, "task_index", f"{path}: line {line}"): str(row["task"])
            for line, row in rows
            if "task_index" in row and "task" in row
        }
    path = root / "meta" / "tasks.parquet"
    if not path.exists():
        return {}
    texts = ("task", "__index_level_0__", "index")  # pandas stores the tasks as the index, which has had several names
    table = read_table(path, ["task_index", *texts])
    text = [c for c in texts if c in table.column_names]
    if not text or "task_index" not in table.column_names:
        present = ", ".join(table.column_names) or "neither"
        raise DataError(f"{path}: it needs the columns task and task_index, but has {present}.")
    rows = enumerate(_rows(table.select(["task_index", text[0]]), path))
    return {_count(row, "task_index", f"{path}: row {line}"): str(row[text[0]]) for line, row in rows}


def _rows(table: Any, path: Path) -> list[dict[str, Any]]:
    try:
        return table.to_pylist()
    except ValueError as error:  # texts that are not text; most of pyarrow's errors are ValueErrors too
        raise DataError(f"{path}: the table cannot be read ({str(error).strip()}). {ADVICE}") from error


_PLACEHOLDER = re.compile(r"\{(\w+)(?::0?(\d)d)?\}")
"""A placeholder in a path template, such as `{episode_index:06d}`. Python's other formats are not supported: they can
access attributes and ask for gigabytes of padding."""


def _format_path(root: Path, info: dict[str, Any], field: str, **values: Any) -> Path:
    """The path template `info[field]`, filled in. Raises DataError if the path leaves `root`."""
    try:
        text = _PLACEHOLDER.sub(lambda m: f"{values[m[1]]:0{m[2]}d}" if m[2] else str(values[m[1]]), info[field])
        if "{" in text:
            raise ValueError(f"{quote(text)} is left")
        return safe_join(root, text)
    except (KeyError, ValueError) as error:
        raise DataError(
            f"{root / 'meta' / 'info.json'}: {field} {quote(info[field])} cannot be filled in ({error}). {ADVICE}"
        ) from error


def _check_info(info: dict[str, Any], path: Path) -> None:
    """Raises DataError for a field of info.json that has the wrong type."""
    fps, features = info["fps"], info["features"]
    if type(fps) not in (int, float) or not 0 < fps <= MAX_COUNT:
        raise DataError(f"{path}: fps is {quote(fps)}, not a rate. {ADVICE}")
    for field in ("data_path", "video_path"):
        if not isinstance(info.get(field) or "", str):
            raise DataError(f"{path}: {field} is {quote(info[field])}, not a path. {ADVICE}")
    if info.get("chunks_size") is not None:
        _count(info, "chunks_size", str(path))
    if info.get("total_episodes") is not None:
        _count(info, "total_episodes", str(path))
    splits = info.get("splits") or {}
    if not isinstance(splits, dict) or set(splits) - {"train"}:
        found = ", ".join(map(quote, splits)) if isinstance(splits, dict) else quote(splits)
        raise DataError(f"{path}: splits is {found}, {_ALL_TRAIN}")
    if not isinstance(features, dict):
        raise DataError(f"{path}: features is {quote(features)}, not an object. {ADVICE}")
    for name, feature in features.items():
        usable = isinstance(feature, dict) and isinstance(feature.get("dtype"), str) and name.isprintable()
        shape = feature.get("shape") if usable else None
        sizes = isinstance(shape, list) and all(type(n) is int and 0 <= n for n in shape)
        if not sizes or math.prod(shape) > MAX_COUNT:
            raise DataError(f"{path}: feature {quote(name)} has no usable dtype and shape. {ADVICE}")
        for key in ("info", "video_info"):
            if not isinstance(feature.get(key) or {}, dict):
                raise DataError(f"{path}: feature {quote(name)}: {key} is no object. {ADVICE}")


_ALL_TRAIN = (
    "but every episode would be read as one of 'train'. Divide the dataset with LeRobot's own scripts; to train on all its "
    'episodes, write "splits": {} there.'
)


def _check_range(splits: dict[str, Any], episodes: list[EpisodeEntry], path: Path) -> None:
    """Raises DataError for a range of episodes of 'train' (`0:50`) that leaves out one of the sorted `episodes`."""
    if "train" not in splits:
        return
    match = re.fullmatch(r"(\d+):(\d+)", str(splits["train"]))
    if not match or not int(match[1]) <= episodes[0].index <= episodes[-1].index < int(match[2]):
        raise DataError(
            f"{path}: splits has {quote(splits['train'])} as 'train', not all episodes from {episodes[0].index} to "
            f"{episodes[-1].index}, {_ALL_TRAIN}"
        )


def _count(row: Mapping[str, Any], name: str, where: str) -> int:
    value = row.get(name)
    if type(value) is not int or not 0 <= value <= MAX_COUNT:
        raise DataError(f"{where} has no usable {name!r} ({quote(value)}). {ADVICE}")
    return value


def _seconds(row: Mapping[str, Any], name: str, where: str) -> float:
    value = row.get(name)
    if type(value) not in (int, float) or not 0 <= value <= MAX_COUNT:
        raise DataError(f"{where} has no usable {name!r} ({quote(value)}). {ADVICE}")
    return float(value)


def _texts(row: Mapping[str, Any], where: str) -> tuple[str, ...]:
    tasks = row.get("tasks") or []
    if not isinstance(tasks, list):
        raise DataError(f"{where} has no usable 'tasks' ({quote(tasks)}). {ADVICE}")
    return tuple(map(str, tasks))


def _json_lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    return read_lines(path, if_missing=ADVICE, advice=ADVICE)
