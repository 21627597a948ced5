"""What lies in an RLDS directory: schema, counts, lengths, cameras and the numbers of its actions.

Owns the facts, read from a sample of episodes so that terabytes take as long as gigabytes.
What the registry should say of the dataset follows from them in `suggest`; drawing and
printing are the caller's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.inspection.action_stats import DimensionFacts, dimension_facts
from data_pipelines.rlds.dataset import SUCCESS_KEY, RldsDataset
from data_pipelines.rlds.images import decode_image
from data_pipelines.rlds.schema import resolve_version, step_key
from data_pipelines.sampling.splits import smallest_hashes
from hma_jax.config import require

INSTRUCTION_KEYS = ("steps/language_instruction", "steps/observation/natural_language_instruction")
WIDEST = 256
"""Values of an action field at most; wider ones are embeddings or images in disguise."""

BLANK_STD = 1.5
"""Grey levels: a frame that varies less over its pixels shows nothing (JPEG noise included)."""


@dataclass(frozen=True)
class FieldFacts:
    """A field of the schema, by the key under which an entry would name it."""

    key: str
    kind: str  # image, depth, number or text
    shape: tuple[int | None, ...]
    dtype: str
    per_step: bool  # False: once per episode


@dataclass(frozen=True)
class SplitFacts:
    name: str
    episodes: int
    shards: int
    bytes: int


@dataclass(frozen=True)
class CameraFacts:
    """One camera over the sampled frames."""

    key: str
    sizes: tuple[tuple[int, int], ...]  # (height, width), all that occur
    frames: int  # looked at
    blank: int  # of those, frames that show one colour
    still: bool  # no sampled episode's frames differ

    @property
    def is_blank(self) -> bool:
        return self.blank == self.frames


@dataclass(frozen=True)
class ActionFacts:
    """A numeric field of actions: one entry per value."""

    key: str
    dimensions: tuple[DimensionFacts, ...]


@dataclass(frozen=True)
class LengthFacts:
    """Steps per sampled episode."""

    shortest: int
    lower: float  # 10th percentile
    median: float
    upper: float  # 90th percentile
    longest: int
    mean: float


@dataclass(frozen=True)
class Facts:
    """Everything about one dataset. `sampled` episodes were read; the rest is metadata."""

    name: str
    version: str
    directory: str
    fields: tuple[FieldFacts, ...]
    splits: tuple[SplitFacts, ...]
    split: str
    episodes: int  # readable ones of this split
    sampled: int
    bytes_read: int
    steps: tuple[int, ...]  # of every sampled episode
    lengths: LengthFacts
    cameras: tuple[CameraFacts, ...]
    actions: tuple[ActionFacts, ...]
    damaged: dict[str, int]  # reason -> episodes


@dataclass(frozen=True)
class Shown:
    """An episode for people: a few frames of every camera, as they are."""

    index: int
    steps: int
    success: bool | None
    instruction: str
    times: tuple[int, ...]  # step of each frame
    frames: dict[str, list[np.ndarray]]  # camera -> uint8 [H, W, 3] each


def inspect_dataset(
    directory: str | Path,
    split: str = "train",
    *,
    episodes: int = 32,
    shown: int = 4,
    frames: int = 8,
    max_bytes: int = 2_000_000_000,
) -> tuple[Facts, list[Shown]]:
    """Facts of one split, and some of its episodes to look at.

    `episodes` drawn by hash are read, fewer if they come to more than `max_bytes`; `frames` of
    each camera are decoded in the first `shown`, two in the others. Damaged records are counted
    and left out. Raises DataError for a directory that is no dataset or has no readable episode,
    ConfigError for an unknown split.
    """
    require(episodes >= 1 and frames >= 2, f"episodes {episodes} or frames {frames} leave nothing to look at")
    fields, splits = _read_schema(resolve_version(directory))
    listed = sum(s.episodes for s in splits if s.name == split)
    source = RldsDataset(directory, split, corrupt="skip", max_skipped=listed)
    cameras = {f.key: _CameraLog() for f in fields if f.per_step and f.kind == "image"}
    numbers = [f.key for f in fields if f.per_step and f.kind == "number" and "action" in f.key]
    numbers = [key for key in numbers if source.features[step_key(key)].size <= WIDEST]
    rows: dict[str, list[np.ndarray]] = {key: [] for key in numbers}
    steps, examples, bytes_read = [], [], 0
    drawn = smallest_hashes(source.name, np.arange(len(source)), episodes, "inspect")
    first = np.unique(np.linspace(0, len(drawn) - 1, shown).round().astype(int))  # those to look at
    for i in [*drawn[first], *np.delete(drawn, first)]:
        if bytes_read > max_bytes:
            break
        try:
            record = _read(source, int(i), cameras, numbers)
            count = _steps(record, source, cameras, numbers)
            wanted = frames if len(examples) < shown else 2
            times = tuple(np.unique(np.linspace(0, count - 1, wanted).round().astype(int)).tolist())
            looked = {key: log.look(record[step_key(key)], times) for key, log in cameras.items()}
        except (EpisodeError, ValueError) as error:
            source.skip(error if isinstance(error, EpisodeError) else EpisodeError(f"episode {i}: {error}"))
            continue
        bytes_read += sum(_size(values) for values in record.values())
        steps.append(count)
        for key in numbers:
            rows[key].append(np.asarray(record[step_key(key)]).reshape(count, -1))
        if len(examples) < shown:
            examples.append(_shown(int(i), count, record, times, looked))
    if not steps:
        reasons = "; ".join(source.skipped) or "it is empty"
        raise DataError(f"{source.directory}: no episode of split {split!r} can be read: {reasons}")
    return Facts(
        name=source.name,
        version=source.version,
        directory=str(source.directory),
        fields=fields,
        splits=splits,
        split=split,
        episodes=len(source),
        sampled=len(steps),
        bytes_read=bytes_read,
        steps=tuple(steps),
        lengths=_lengths(steps),
        cameras=tuple(log.facts(key) for key, log in cameras.items()),
        actions=tuple(ActionFacts(key, dimension_facts(rows[key])) for key in numbers),
        damaged=dict(source.skipped),
    ), examples


# --- schema -----------------------------------------------------------------------------------


def _read_schema(directory: Path) -> tuple[tuple[FieldFacts, ...], tuple[SplitFacts, ...]]:
    """Fields of a step and of the episode, and all splits, through tfds."""
    import tensorflow_datasets as tfds
    from google.protobuf.json_format import ParseError

    try:
        info = tfds.builder_from_directory(str(directory)).info
        splits = [
            SplitFacts(name, sum(s.shard_lengths), len(s.shard_lengths), int(s.num_bytes))
            for name, s in sorted(info.splits.items())
        ]
    except (OSError, ValueError, KeyError, ParseError) as error:
        raise DataError(
            f"{directory}: dataset_info.json or features.json is missing or damaged ({error}). "
            "Restore both as tfds wrote them."
        ) from error
    return tuple(_fields(info.features, "")), tuple(splits)


def _fields(feature: Any, key: str) -> list[FieldFacts]:
    import tensorflow_datasets as tfds

    if isinstance(feature, tfds.features.FeaturesDict):
        found = []
        for name, child in sorted(feature.items()):
            found += _fields(child, f"{key}/{name}" if key else name)
        return found
    if isinstance(feature, (tfds.features.Dataset, tfds.features.Sequence)):
        return _fields(feature.feature, key)
    shape, dtype = tuple(feature.shape), np.dtype(feature.np_dtype)
    if isinstance(feature, tfds.features.Image):
        kind = "image" if shape[-1] == 3 and dtype == np.uint8 else "depth"
    else:
        kind = "number" if dtype.kind in "fiub" and None not in shape else "text"
    dtype = dtype.name if dtype.kind in "fiub" else "string"
    return [FieldFacts(key.removeprefix("steps/"), kind, shape, dtype, per_step=key.startswith("steps/"))]


# --- one episode ------------------------------------------------------------------------------


def _read(source: RldsDataset, i: int, cameras: dict, numbers: Sequence[str]) -> dict:
    keys = [step_key(key) for key in (*cameras, *numbers)]
    record = source.record(i, [*keys, *INSTRUCTION_KEYS, SUCCESS_KEY, "steps/is_first"])
    return {key: [] for key in keys} | record


def _steps(record: dict, source: RldsDataset, cameras: dict, numbers: Sequence[str]) -> int:
    """Steps of an episode. Raises EpisodeError when its fields disagree."""
    counts = {key: len(record[step_key(key)]) for key in cameras}
    for key in numbers:
        counts[key] = len(record[step_key(key)]) / source.features[step_key(key)].size
    if not counts:
        counts["is_first"] = len(record.get("steps/is_first", ()))
    if len(set(counts.values())) != 1 or not max(counts.values()):
        found = ", ".join(f"{key} {n:g}" for key, n in counts.items())
        raise EpisodeError(f"an episode whose fields differ in length, or without steps ({found})")
    return int(max(counts.values()))


class _CameraLog:
    """What was seen of one camera so far."""

    def __init__(self):
        self.sizes: set[tuple[int, int]] = set()
        self.frames = self.blank = 0
        self.still = True

    def look(self, encoded: list[bytes], times: Sequence[int]) -> list[np.ndarray]:
        """The decoded frames at `times`, noted."""
        images = [decode_image(encoded[t]) for t in times]
        self.sizes |= {image.shape[:2] for image in images}
        self.frames += len(images)
        self.blank += sum(bool(image.std(axis=(0, 1)).max() < BLANK_STD) for image in images)
        first = images[0].astype(np.int16)
        moves = [im.shape != first.shape or np.abs(im - first).max() > 8 * BLANK_STD for im in images]
        self.still &= not any(moves)
        return images

    def facts(self, key: str) -> CameraFacts:
        return CameraFacts(key, tuple(sorted(self.sizes)), self.frames, self.blank, self.still)


def _shown(i: int, steps: int, record: dict, times: tuple[int, ...], looked: dict) -> Shown:
    text = next((record[key][0] for key in INSTRUCTION_KEYS if record.get(key)), b"")
    success = record.get(SUCCESS_KEY)
    known = success is not None and len(success) == 1
    return Shown(i, steps, bool(success[0]) if known else None, text.decode(errors="replace"), times, looked)


def _size(values: np.ndarray | list[bytes]) -> int:
    return sum(map(len, values)) if isinstance(values, list) else values.nbytes


def _lengths(steps: Sequence[int]) -> LengthFacts:
    lower, median, upper = np.percentile(steps, [10, 50, 90]).tolist()
    return LengthFacts(min(steps), lower, median, upper, max(steps), float(np.mean(steps)))
