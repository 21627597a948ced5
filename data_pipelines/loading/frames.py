"""Random camera frames straight from the sources: what a tokenizer trains on.

Owns the order of frames and the exclusion of held-out episodes. Row r of batch s is a pure
function of (datasets, seed, s, r), so a run resumes from its step alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.loading.endless import iterate
from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.draws import Draws
from data_pipelines.sampling.mixture import make_mixture
from data_pipelines.sampling.order import ENDLESS, endless_shuffle, hash64, stream_seed
from data_pipelines.sampling.splits import HeldOut, used_episodes
from data_pipelines.sources.identity import describe
from data_pipelines.sources.joined import Parts
from data_pipelines.sources.open import open_source
from data_pipelines.sources.rlds.images import decoding_threads, fit_image
from data_pipelines.sources.rlds.location import OpenFiles
from data_pipelines.sources.source import MAX_SKIPPED, Corrupt, EpisodeSource
from hma_jax.config import require

FRAMES_PER_READ = 4
"""Number of frames in a batch that come from one episode: reading its record costs more than decoding a frame."""

PREFETCH_BATCHES = 8
"""Batches that are prefetched, at least one per thread."""


def make_frame_loader(
    datasets: Sequence[tuple[DatasetSpec, str | Path | Parts]],
    image_size: int,
    batch: int,
    seed: int,
    start_step: int = 0,
    *,
    tau: float,
    held_out: HeldOut,
    split: Literal["train", "val"] = "train",
    corrupt: Corrupt = "raise",
    max_skipped: float = MAX_SKIPPED,
    threads: int | None = None,
) -> FrameLoader:
    """Endless batches of frames, uint8 [B, image_size, image_size, 3].

    Datasets are drawn with p ∝ episodes^(1/tau), episodes and frames within them uniformly.
    The episodes of a split are those that the token store has with the same `held_out`. `threads` (default: one per
    core, up to 8) read and decode; their number changes no frame. Raises ConfigError and DataError as `open_source`
    does.
    """
    require(batch >= 1, f"batch must be at least 1, got {batch}")
    require(split in ("train", "val"), f"split must be 'train' or 'val', got {split!r}")
    require(len(datasets) >= 1, "no dataset was given")
    streams, counts, reasons, files = {}, {}, {}, OpenFiles()
    for spec, directory in datasets:
        source = open_source(directory, spec.split, corrupt=corrupt, max_skipped=max_skipped, files=files)
        source.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
        all_trained, all_held_out = used_episodes(spec, source.runs, held_out)
        episodes = np.flatnonzero((all_held_out if split == "val" else all_trained)[source.numbers])
        counts[spec.name] = len(episodes)
        if not len(episodes):
            why = f": {_why_none_held_out(spec, all_held_out, len(source), held_out)}" if split == "val" else ""
            reasons[spec.name] = f"it has no {split} episode{why}"
            continue
        order = stream_seed(seed, "frames", split, spec.name)
        streams[spec.name] = _FrameStream(source, spec, episodes, order)
    mixture = make_mixture(counts, tau, reasons)
    group = math.gcd(batch, FRAMES_PER_READ)
    draws = Draws(mixture.weights, f"frames/{split}/{seed}")
    batches = _FrameBatches(tuple(streams[n] for n in mixture.names), draws, batch, group, image_size)
    threads = decoding_threads() if threads is None else threads
    return FrameLoader(batches, iterate(batches, start_step, threads, ahead=max(threads, PREFETCH_BATCHES)))


def _why_none_held_out(spec: DatasetSpec, all_held_out: np.ndarray, readable: int, amount: HeldOut) -> str:
    """Why none of the `readable` episodes is held out; `all_held_out`: a bool for every episode, readable or not."""
    bound = (
        f"val_fraction={amount.val_fraction:g}, min_val={amount.min_val} and max_val={amount.max_val} set how many are"
    )
    if all_held_out.any():
        return f"all {all_held_out.sum():,} held-out episodes of its {len(all_held_out):,} were skipped; {bound}"
    where = " in one of its parts" if spec.joins else ""
    return f"of {readable} none is held out: this needs at least two{where}; {bound}"


@dataclass(frozen=True)
class FrameLoader(Iterator[np.ndarray]):
    """Batches one after the other, and the episodes from which each is made."""

    batches: _FrameBatches
    iterator: Iterator[np.ndarray]

    def __next__(self) -> np.ndarray:
        return next(self.iterator)

    def describe(self, step: int) -> list[str]:
        """The episodes whose frames are in batch `step` (from 0 on): dataset, file and episode."""
        return self.batches.describe(step)

    def episodes(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """(dataset, drawn episode) of every frame of batch `step`, as numbers, int64 [B] each: frames of one episode
        are not independent. Under 'skip' a damaged episode keeps its number, though another is read in its place."""
        return self.batches.episodes(step)


@dataclass(frozen=True)
class _FrameStream:
    """Endless shuffled episodes of one dataset."""

    source: EpisodeSource
    spec: DatasetSpec
    episodes: np.ndarray  # int64, those of the split
    seed: int

    def read(self, i: int, draws: np.ndarray) -> list[np.ndarray]:
        """One frame of the i-th drawn episode for each number of `draws` (uint64); see `EpisodeSource.frames`."""
        at = self._drawn(i)
        for k in range(len(self.episodes)):  # the drawn episode or, under 'skip', the next usable one
            episode = int(self.episodes[(at + k) % len(self.episodes)])
            try:
                return self.source.frames(episode, self.spec.image_key, lambda n: (draws % n).tolist())
            except EpisodeError as error:
                self.source.skip(episode, error)
        raise DataError(f"{self.source.name}: none of its {len(self.episodes)} episodes can be read")

    def describe(self, i: int) -> str:
        """The i-th episode drawn, for people."""
        return f"{self.source.name}: {describe(self.source.runs, self.number(i))}"

    def number(self, i: int) -> int:
        """Number, among all episodes in the files, of the i-th episode that was drawn."""
        return int(self.source.numbers[self.episodes[self._drawn(i)]])

    def _drawn(self, i: int) -> int:
        return int(endless_shuffle(i, len(self.episodes), self.seed))


@dataclass(frozen=True)
class _FrameBatches:
    """Element s: the frames of batch s, in groups of `group` frames of one episode."""

    streams: tuple[_FrameStream, ...]
    draws: Draws
    batch: int
    group: int
    size: int

    def __len__(self) -> int:
        return ENDLESS // self.batch

    def __getitem__(self, step: int) -> np.ndarray:
        """uint8 [batch, H, W, 3]."""
        streams, positions = self._chosen(step)
        seeds = np.asarray([self.streams[d].seed for d in streams], np.uint64)
        draws = hash64(positions[:, None] * self.group + np.arange(self.group), seeds[:, None])
        frames = np.empty((self.batch, self.size, self.size, 3), np.uint8)
        row = 0
        for d, i, drawn in zip(streams.tolist(), positions.tolist(), draws, strict=True):
            for image in self.streams[d].read(i, drawn):
                frames[row] = self.streams[d].spec.correct(fit_image(image, self.size))
                row += 1
        return frames

    def describe(self, step: int) -> list[str]:
        return [self.streams[d].describe(i) for d, i in zip(*map(np.ndarray.tolist, self._chosen(step)), strict=True)]

    def episodes(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """See `FrameLoader.episodes`."""
        datasets, positions = self._chosen(step)
        drawn = [self.streams[d].number(i) for d, i in zip(datasets.tolist(), positions.tolist(), strict=True)]
        return np.repeat(datasets, self.group), np.repeat(np.asarray(drawn, np.int64), self.group)

    def _chosen(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """(dataset, number of earlier draws from it) of every group."""
        groups = self.batch // self.group
        return self.draws.at(step * groups + np.arange(groups))
