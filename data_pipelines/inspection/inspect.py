"""Inspection of a dataset: schema, counts, lengths, cameras and statistics of its actions.

Owns these facts, read from a sample of episodes so that terabytes take as long as gigabytes. `suggest` derives a
registry entry from them; drawing and printing are the caller's.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import MAX_LISTED, DataError, EpisodeError, without_advice
from data_pipelines.inspection.action_stats import DimensionFacts, dimension_facts
from data_pipelines.inspection.duplicates import Fingerprint, take_fingerprint
from data_pipelines.inspection.sample import ExampleEpisode, shrink
from data_pipelines.sampling.splits import smallest_hashes
from data_pipelines.sources.identity import describe
from data_pipelines.sources.open import open_source
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.features import NUMBERS, FlatFeature
from data_pipelines.sources.rlds.schema import field_slice, read_info, step_key
from data_pipelines.sources.source import (
    INSTRUCTION_KEYS,
    SUCCESS_KEY,
    EpisodeSource,
    SourceFrame,
    action_fields,
    decode_frame,
    find_instructions,
    find_success,
)
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

MAX_ACTION_WIDTH = 256
"""Largest number of values of a field that is taken for an action because of its name; wider ones are usually
embeddings or flattened images. The fields `action` and `actions` themselves may be wider: they may hold the actions of
several steps."""

NOT_READ = "no camera"
"""What images are called that are not read as such: LeRobot's depth and grey images, robomimic's under other names."""

BLANK_STD = 1.5
"""Grey levels: a frame that varies less over its pixels shows nothing (JPEG noise included)."""


@dataclass(frozen=True)
class FieldFacts:
    """A field of the schema, by the key under which an entry would name it."""

    key: str
    kind: str  # image, depth, number, list (of numbers, of any length), bytes (numbers stored so), text or NOT_READ
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
    sizes: tuple[tuple[int, int], ...]  # (height, width): all sizes that occur
    frames: int  # frames that were decoded
    blank: int  # of these, frames of one colour
    still: bool  # in every sampled episode all frames are the same
    undecodable: int = 0  # sampled episodes in which a frame of it is missing or cannot be decoded; others are read
    reason: str = ""  # why, in the first of these

    @property
    def is_blank(self) -> bool:
        return self.blank == self.frames > 0


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
    episodes: int  # readable episodes of this split
    sampled: int
    bytes_read: int
    steps: tuple[int, ...]  # of every sampled episode
    lengths: LengthFacts
    cameras: tuple[CameraFacts, ...]
    actions: tuple[ActionFacts, ...]
    damaged: dict[str, int]  # reason -> episodes
    hz: float | None = None  # native rate, where the files say it
    stopped: bool = False  # stopped before all drawn episodes were read: they have too many bytes


@dataclass(frozen=True)
class Sample:
    """What was read of a dataset."""

    facts: Facts
    examples: tuple[ExampleEpisode, ...]
    fingerprints: tuple[Fingerprint, ...]  # of every sampled episode


def inspect_dataset(
    directory: str | Location,
    split: str = "train",
    *,
    episodes: int = 32,
    max_examples: int = 4,
    frames: int = 8,
    max_bytes: int = 2_000_000_000,
    action_keys: Sequence[str] = (),
) -> Sample:
    """Facts of one split, example episodes, and fingerprints by which to find duplicates.

    Reads `episodes`, drawn by hash, or fewer if they exceed `max_bytes`; `frames` of each camera are decoded in the
    first `max_examples`, two in the others. Fields of numbers count as actions if their name says so, or if an entry
    uses them as its `action_keys`. Damaged records are counted and left out. A camera that cannot be decoded in an
    episode, or has another number of frames than its action, is counted, and the others are read.

    Raises DataError for a directory that is no dataset or has no readable episode, ConfigError for an
    unknown split.
    """
    require(episodes >= 1, f"episodes must be at least 1, got {episodes}")
    require(frames >= 2, f"frames must be at least 2, got {frames}: a camera's first and last are compared")
    source = open_source(directory, split, corrupt="skip", max_skipped=sys.maxsize)
    fields, splits = _describe(source)
    _require_steps(source, fields)
    log = _SampleLog(source, fields, action_keys, max_examples, frames)
    drawn = smallest_hashes(source.name, source.ids[source.numbers], episodes, "inspect")
    first = np.unique(np.linspace(0, len(drawn) - 1, max_examples).round().astype(int))  # the examples
    stopped = False
    for i in [*drawn[first], *np.delete(drawn, first)]:
        if stopped := log.bytes_read > max_bytes:
            break
        log.read(int(i))
    damaged = Counter[str]()
    for reason, count in source.skipped.items():
        damaged[without_advice(reason)] += count
    if not log.steps:
        reasons = "; ".join(list(damaged)[:MAX_LISTED]) or "it is empty"
        more = f"; {len(damaged) - MAX_LISTED:,} more" if len(damaged) > MAX_LISTED else ""
        raise DataError(f"{source.location}: no episode of split {split!r} can be read: {reasons}{more}")
    facts = Facts(
        name=source.name,
        version=source.version,
        directory=str(source.location),
        fields=fields,
        splits=splits,
        split=split,
        episodes=len(source),
        sampled=len(log.steps),
        bytes_read=log.bytes_read,
        steps=tuple(log.steps),
        lengths=_lengths(log.steps),
        cameras=tuple(camera.facts() for camera in log.cameras.values()),
        actions=tuple(ActionFacts(key, dimension_facts(rows)) for key, rows in log.actions.items() if rows),
        damaged=dict(damaged),
        hz=source.hz,
        stopped=stopped,
    )
    return Sample(facts, tuple(log.examples), tuple(log.fingerprints))


# --- schema -----------------------------------------------------------------------------------


def _describe(source: EpisodeSource) -> tuple[tuple[FieldFacts, ...], tuple[SplitFacts, ...]]:
    """Fields of a step and of the episode, and all splits."""
    if isinstance(source, RldsDataset):
        splits = (
            SplitFacts(name, sum(split.shard_lengths), len(split.shard_lengths), split.bytes)
            for name, split in sorted(read_info(source.directory).splits.items())
        )
        return tuple(_field(key, feature) for key, feature in sorted(source.features.items())), tuple(splits)
    fields = []
    for key, feature in source.features.items():
        if feature.image:
            what: tuple = "image", (None, None, 3), "uint8"
        elif feature.shape:
            what = NOT_READ, feature.shape, ""
        else:
            what = "number", (feature.size,), "float32"
        fields.append(FieldFacts(key.removeprefix("steps/"), *what, per_step=True))
    return tuple(fields), (SplitFacts(source.split, len(source), source.files, int(source.sizes().sum())),)


def _field(key: str, feature: FlatFeature) -> FieldFacts:
    if feature.image:
        kind = "image" if feature.camera else "depth"  # a grey image is decoded to three equal channels
    elif feature.encoding:
        kind = "bytes"
    else:
        kind = "text" if feature.dtype not in NUMBERS else "list" if None in feature.shape else "number"
    dtype = feature.dtype if feature.dtype in NUMBERS else "string"
    return FieldFacts(key.removeprefix("steps/"), kind, feature.shape, dtype, key.startswith("steps/"))


def _require_steps(source: EpisodeSource, fields: Sequence[FieldFacts]) -> None:
    """Raises DataError for records without any field of a step: these are not episodes."""
    if not any(f.per_step for f in fields):
        keys = ", ".join(f.key for f in fields[:MAX_LISTED])
        raise DataError(
            f"{source.schema}: none of its fields ({keys}) is below `steps`, so its records are not episodes. Give a "
            "dataset in the RLDS layout, or write this one in it (docs/own_data.md, Writing RLDS)."
        )


# --- episodes ---------------------------------------------------------------------------------


class _SampleLog:
    """Reads episodes one by one and keeps what is needed for the facts."""

    def __init__(
        self,
        source: EpisodeSource,
        fields: Sequence[FieldFacts],
        action_keys: Sequence[str],
        max_examples: int,
        frames: int,
    ):
        self._source, self._max_examples, self._frames = source, max_examples, frames
        self.cameras = {f.key: _CameraLog(f.key) for f in fields if f.per_step and f.kind == "image"}
        sizes = {f.key: source.features[step_key(f.key)].size for f in fields if f.per_step and f.kind == "number"}
        taken = {"action", "actions", *(field_slice(key)[0] for key in action_keys)}
        self._numbers = [k for k, n in sizes.items() if n and (k in taken or "action" in k and n <= MAX_ACTION_WIDTH)]
        used = {field_slice(key)[0] for key in action_keys} or action_fields(self._numbers)
        self._action = [key for key in self._numbers if key in used]  # what an episode must have
        self._sizes = {key: sizes[key] for key in self._numbers}
        self.actions: dict[str, list[np.ndarray]] = {key: [] for key in self._numbers}  # field -> [N, A] per episode
        self.steps: list[int] = []
        self.examples: list[ExampleEpisode] = []
        self.fingerprints: list[Fingerprint] = []
        self.bytes_read = 0

    def read(self, i: int) -> None:
        """Episode `i`; a damaged one is counted by the source."""
        source, number = self._source, int(self._source.numbers[i])
        is_example = len(self.examples) < self._max_examples
        try:
            record = _read(source, i, self.cameras, self._numbers)
            count = _steps(record, source, self.cameras, self._action)
            wanted = self._frames if is_example else 2
            times = tuple(np.unique(np.linspace(0, count - 1, wanted).round().astype(int)).tolist())
            looked = _look(record, self.cameras, count, times, describe(source.runs, number))
        except EpisodeError as error:
            source.skip(i, error)
            return
        except ValueError as error:
            source.skip(i, EpisodeError(f"{describe(source.runs, number)}: {error}"))
            return
        self.bytes_read += sum(_size(values) for values in record.values())
        self.steps.append(count)
        found = {key: np.asarray(record[step_key(key)]) for key in self._numbers}
        actions = {
            key: values.reshape(count, -1)
            for key, values in found.items()
            if values.dtype.kind in "biuf" and values.size == count * self._sizes[key]
        }
        for key, rows in actions.items():
            self.actions[key].append(rows)
        compared = [actions.get(key, np.full((count, size), np.nan)) for key, size in self._sizes.items()]
        self.fingerprints.append(take_fingerprint(*_named(source, i), count, looked, compared))
        if is_example:
            self.examples.append(_example(number, count, record, times, looked, actions))


def _named(source: EpisodeSource, i: int) -> tuple[str, int]:
    """(split, number in it) of an episode, also if several splits are read together ("train+val")."""
    number, before = int(source.numbers[i]), Counter[str]()
    for run in source.runs:
        if number < run.count:
            return run.split or source.split, before[run.split] + number
        number -= run.count
        before[run.split] += run.count
    raise IndexError(i)


def _read(source: EpisodeSource, i: int, cameras: dict, numbers: Sequence[str]) -> dict:
    keys = [step_key(key) for key in (*cameras, *numbers)]
    record = source.record(i, [*keys, *INSTRUCTION_KEYS, SUCCESS_KEY, "steps/is_first"])
    return {key: [] for key in keys} | record


def _steps(record: dict, source: EpisodeSource, cameras: dict, action: Sequence[str]) -> int:
    """Number of steps of an episode: of its action, or else of its longest camera. Raises ValueError if the fields of
    the action disagree, or if no camera has as many frames."""
    for key in action:
        if len(values := record[step_key(key)]) and not isinstance(values, np.ndarray):
            raise ValueError(f"its {key} holds bytes")
    counts = {key: _count_frames(record[step_key(key)]) for key in cameras}
    frames, shown, other_widths = max(counts.values(), default=0), set(counts.values()), {}
    for key in action:
        values, size = len(record[step_key(key)]), source.features[step_key(key)].size
        counts[key] = values / size
        if frames and values and values != frames * size and not values % frames:
            other_widths[key] = f" of {size} values, or {frames} of {values // frames}"
    if not counts:
        counts["is_first"] = len(record.get("steps/is_first", ()))
    steps = {counts[key] for key in action} or {max(counts.values())}
    if len(steps) != 1 or not max(steps) or cameras and not steps <= shown:
        found = ", ".join(f"{key} {n:g}{other_widths.get(key, '')}" for key, n in counts.items())
        raise ValueError(f"its fields differ in length, or it has no step ({found})")
    return int(max(steps))


def _count_frames(values: Sequence) -> int:
    return 0 if isinstance(values, np.ndarray) else len(values)  # numbers in the place of images


def _look(
    record: dict, cameras: dict[str, _CameraLog], steps: int, times: Sequence[int], where: str
) -> dict[str, list]:
    """The frames at `times` of every camera that has one for each step and can be decoded; the logs count those that
    cannot. One broken camera is no failure, since an entry takes only one. Raises EpisodeError if no camera can be
    decoded."""
    looked, failures = {}, {}
    for key, log in cameras.items():
        frames = record[step_key(key)]
        try:
            if (count := _count_frames(frames)) != steps:
                raise EpisodeError(f"{where}: {key} has {count} frames, but there are {steps} steps")
            looked[key] = log.look(frames, times, where)
        except EpisodeError as error:
            failures[key] = error
    if failures and not looked:
        raise next(iter(failures.values()))
    for key, error in failures.items():
        cameras[key].fail(error)
    return looked


class _CameraLog:
    """Collects the facts of one camera."""

    def __init__(self, key: str):
        self._key = key
        self.sizes: set[tuple[int, int]] = set()
        self.frames = self.blank = self.undecodable = 0
        self.still, self.reason = True, ""

    def look(self, encoded: Sequence[SourceFrame], times: Sequence[int], where: str) -> list[np.ndarray]:
        """The decoded frames at `times`; records their facts. Raises EpisodeError for one that cannot be decoded."""
        images = [self._decode(encoded[t], f"{where}: step {t} of {self._key}") for t in times]
        self.sizes |= {image.shape[:2] for image in images}
        self.frames += len(images)
        self.blank += sum(bool(image.std(axis=(0, 1)).max() < BLANK_STD) for image in images)
        first = images[0].astype(np.int16)
        moves = [im.shape != first.shape or np.abs(im - first).max() > 8 * BLANK_STD for im in images]
        self.still &= not any(moves)
        return images

    def fail(self, error: EpisodeError) -> None:
        """Records an episode in which a frame is missing or cannot be decoded."""
        self.undecodable += 1
        self.reason = self.reason or without_advice(str(error))

    @staticmethod
    def _decode(frame: SourceFrame, where: str) -> np.ndarray:
        return decode_frame(frame, lambda what: EpisodeError(f"{where} {what}"))

    def facts(self) -> CameraFacts:
        sizes, still = tuple(sorted(self.sizes)), self.still and self.frames > 0
        return CameraFacts(self._key, sizes, self.frames, self.blank, still, self.undecodable, self.reason)


def _example(i: int, steps: int, record: dict, times: tuple[int, ...], looked: dict, actions: dict) -> ExampleEpisode:
    frames = {camera: [shrink(frame) for frame in own] for camera, own in looked.items()}
    text = find_instructions(record, steps)[0]
    return ExampleEpisode(i, steps, find_success(record), text, times, frames, actions)


def _size(values: np.ndarray | list[bytes]) -> int:
    return sum(map(len, values)) if isinstance(values, list) else values.nbytes


def _lengths(steps: Sequence[int]) -> LengthFacts:
    lower, median, upper = np.percentile(steps, [10, 50, 90]).tolist()
    return LengthFacts(min(steps), lower, median, upper, max(steps), float(np.mean(steps)))
