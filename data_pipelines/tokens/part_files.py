"""One part of a dataset in the token store: its files, and the facts file that marks it as complete.

Owns how a part is written, validated and described. A part holds a range of the source's episodes. The ranges depend
only on the source, so any number of processes, killed and restarted at will, make the same files.

    <dataset>/train-00003-of-00120.array_record   its training episodes, if any
    <dataset>/train-00003-of-00120.moments.npy    statistics of the actions of each of these
    <dataset>/val-00003-of-00120.array_record     its held-out episodes, if any
    <dataset>/val-00003-of-00120.actions.npy      the actions of all of these, where their records hold frames
    <dataset>/parts/00003.json                    its facts, written after the other files
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from array_record.python import array_record_module

from data_pipelines.errors import DataError
from data_pipelines.publishing.files import sync
from data_pipelines.tokens.beside import read_beside, write_beside
from data_pipelines.tokens.episode_record import StoredEpisode, encode_episode
from data_pipelines.tokens.manifest import SPLITS, SkippedEpisodes, part_name
from data_pipelines.tokens.moments import MOMENTS, Moments, merge_all, read_moments
from data_pipelines.tokens.row_sample import RowSample, RowSampler, rows_of_part
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict, to_dict

ACTIONS = "actions"
"""The file beside a part whose records hold frames: the native actions of its episodes, one after the other."""

FACTS = "parts"
"""Directory of the facts of all parts."""

PartItem = tuple[str, StoredEpisode] | SkippedEpisodes
"""An item of a part: an episode with its split, or an unusable one."""


@dataclass(frozen=True)
class Part:
    """Part `number` of `count`: of the source's episodes that are read, those from `first` up to but not including
    `end`."""

    number: int
    count: int
    first: int
    end: int

    @property
    def episodes(self) -> range:
        return range(self.first, self.end)


@dataclass(frozen=True)
class PartSplit:
    """The episodes of one split in one part, in store order."""

    episodes: tuple[int, ...]  # index in the source
    steps: tuple[int, ...]  # native frames N
    content: str  # hash over the records
    size: int  # bytes of the file; 0: there is none


@dataclass(frozen=True)
class PartFacts:
    part: Part
    train: PartSplit
    val: PartSplit
    moments: Moments  # of the native actions of the train split
    lost: tuple[SkippedEpisodes, ...]  # called so in the file
    sample: RowSample = RowSample()  # of the same actions


def write_part(
    directory: Path, part: Part, items: Iterable[PartItem], scratch: Path, action_dim: int, keep_frames: set[str]
) -> PartFacts:
    """Writes `items` as a part of the dataset in `directory`, atomically; an existing part is replaced.

    `scratch` is a directory for temporary files on the same disk, `keep_frames` the splits whose records hold
    frames. Raises OSError.
    """
    writers = {
        split: _SplitWriter(scratch / part_name(split, part.number, part.count), split in keep_frames)
        for split in SPLITS
    }
    skipped: list[SkippedEpisodes] = []
    moments, sampler = [], RowSampler(rows_of_part(part.count))
    actions: dict[str, list[np.ndarray]] = {}
    for item in items:
        if isinstance(item, SkippedEpisodes):
            skipped.append(item)
            continue
        split, episode = item
        if split == "train":
            moments.append(Moments.of(episode.actions))
            sampler.add(episode.actions, episode.episode)
        if split in keep_frames:
            actions.setdefault(split, []).append(np.asarray(episode.actions, np.float32))
        writers[split].add(episode)
    paths = {split: directory / part_name(split, part.number, part.count) for split in SPLITS}
    if moments:
        write_beside(paths["train"], MOMENTS, np.stack([one.row for one in moments]), scratch)
    for split, own in actions.items():
        write_beside(paths[split], ACTIONS, np.concatenate(own), scratch)
    splits = [writers[split].close() for split in SPLITS]
    facts = PartFacts(part, *splits, merge_all(moments, action_dim), tuple(skipped), sampler.sample())
    new_facts = scratch / "facts.json"
    new_facts.write_text(json.dumps(to_dict(facts)))
    sync(new_facts)
    for split, values in zip(SPLITS, splits, strict=True):
        if values.size:
            os.replace(scratch / paths[split].name, paths[split])
        else:
            paths[split].unlink(missing_ok=True)
    sync(directory)
    os.replace(new_facts, _facts_path(directory, part))
    sync(directory / FACTS)
    return facts


def read_part(directory: Path, part: Part) -> PartFacts | None:
    """The facts of a finished part; None if it is missing, or its files do not have the sizes they were written with.

    Sizes are enough to detect what a crash or a full disk leaves behind; for the arrays beside the records, numbers of
    rows.
    """
    try:
        facts = from_dict(PartFacts, json.loads(_facts_path(directory, part).read_text()))
    except (OSError, ValueError, AttributeError, TypeError, ConfigError):
        return None
    for split in SPLITS:
        path, own = directory / part_name(split, part.number, part.count), getattr(facts, split)
        size = path.stat().st_size if path.is_file() else 0
        if size != own.size or (own.episodes and not _reads_beside(path, split, own)):
            return None
    return facts if facts.part == part else None


def read_actions(part: Path, steps: int) -> np.ndarray | None:
    """float32 [steps, A]: the native actions of a part's episodes; None if only the records have them, as those without
    frames. Raises as `read_beside`."""
    of, advice = f"the actions of {steps} steps", "Remove the file, and they are read with the frames."
    return read_beside(part, ACTIONS, steps, np.float32, of, advice)


def _reads_beside(path: Path, split: str, own: PartSplit) -> bool:
    """Whether the arrays beside the records at `path` belong to these episodes."""
    try:
        read_actions(path, sum(own.steps))
        if split == "train":
            read_moments(path, len(own.episodes))
    except DataError:
        return False
    return True


def _facts_path(directory: Path, part: Part) -> Path:
    return directory / FACTS / f"{part.number:05d}.json"


class _SplitWriter:
    """Appends episodes to one ArrayRecord file, created for the first one, and collects its facts."""

    def __init__(self, path: Path, keep_frames: bool):
        # Tokens do not compress; frames do. One record per group gives true random access.
        self._options = "group_size:1" if keep_frames else "group_size:1,uncompressed"
        self._path = path
        self._writer = None
        self._episodes: list[int] = []
        self._steps: list[int] = []
        self._content = hashlib.sha256()

    def add(self, episode: StoredEpisode) -> None:
        record = encode_episode(episode)
        with self._errors():
            if self._writer is None:
                self._writer = array_record_module.ArrayRecordWriter(str(self._path), self._options)
            self._writer.write(record)
        self._content.update(record)
        self._episodes.append(episode.episode)
        self._steps.append(len(episode.actions))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """ArrayRecord reports a full disk, or a directory that is gone, as RuntimeError."""
        try:
            yield
        except RuntimeError as error:
            kind = OSError if self._path.parent.is_dir() else FileNotFoundError
            raise kind(str(error)) from error

    def close(self) -> PartSplit:
        size = 0
        if self._writer is not None:
            with self._errors():
                self._writer.close()
            sync(self._path)
            size = self._path.stat().st_size
        digest = self._content.hexdigest()[:32]
        return PartSplit(tuple(self._episodes), tuple(self._steps), digest, size)
