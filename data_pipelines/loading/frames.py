"""Random camera frames straight from RLDS shards: what a tokenizer trains on.

Owns the order of frames and the exclusion of held-out episodes. Row r of batch s is a pure
function of (datasets, seed, s, r), so a run resumes from its step alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import grain
import numpy as np

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.loading.mixture import make_mixture
from data_pipelines.loading.order import ENDLESS, endless_shuffle, random_below, stream_seed
from data_pipelines.loading.splits import held_out
from data_pipelines.registry import DatasetSpec
from data_pipelines.rlds.dataset import MAX_SKIPPED, RldsDataset
from data_pipelines.rlds.images import fit_image
from hma_jax.config import require

FRAMES_PER_READ = 4
"""Frames taken from one episode at a time: reading the record costs more than decoding a frame."""


def make_frame_loader(
    datasets: Sequence[tuple[DatasetSpec, str | Path]],
    image_size: int,
    batch: int,
    seed: int,
    start_step: int = 0,
    tau: float = 3.0,
    val_fraction: float = 0.05,
    min_val: int = 2,
    max_val: int = 200,
    split: Literal["train", "val"] = "train",
    corrupt: Literal["raise", "skip"] = "raise",
    max_skipped: int = MAX_SKIPPED,
    threads: int = 2,
) -> Iterator[np.ndarray]:
    """Endless batches of frames, uint8 [B, image_size, image_size, 3].

    Datasets are drawn with p ∝ episodes^(1/tau), episodes and frames within them uniformly.
    Held-out episodes are those that the token store holds out under the same fractions.
    Raises ConfigError and DataError as `RldsDataset` does.
    """
    require(batch >= 1, f"batch must be at least 1, got {batch}")
    require(split in ("train", "val"), f"split must be 'train' or 'val', got {split!r}")
    require(len(datasets) >= 1, "no dataset was given to take frames from")
    group = math.gcd(batch, FRAMES_PER_READ)
    streams, counts = {}, {}
    for spec, directory in datasets:
        source = RldsDataset(directory, spec.split, corrupt=corrupt, max_skipped=max_skipped)
        source.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
        mask = held_out(spec.name, len(source), val_fraction, min_val, max_val)
        episodes = np.flatnonzero(mask if split == "val" else ~mask)
        counts[spec.name] = len(episodes)
        if not len(episodes):
            continue
        seed_here = stream_seed(seed, "frames", split, spec.name)
        streams[spec.name] = _FrameGroups(source, spec.image_key, episodes, image_size, group, seed_here)
    mixture = make_mixture(counts, tau, dict.fromkeys(counts, f"it has no {split} episode"))
    mixed = grain.MapDataset.mix(
        [grain.MapDataset.source(streams[n]) for n in mixture.names], mixture.weights
    )
    groups = mixed.batch(batch // group).map(lambda x: x.reshape(-1, *x.shape[2:]))
    iterator = iter(groups.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=8)))
    iterator.set_state({"next_index": start_step})
    return iterator


@dataclass(frozen=True)
class _FrameGroups:
    """Endless source: element i is `count` random frames of one episode, uint8 [count, H, W, 3]."""

    source: RldsDataset
    image_key: str
    episodes: np.ndarray
    size: int
    count: int
    seed: int

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, i: int) -> np.ndarray:
        at = endless_shuffle(i, len(self.episodes), self.seed)
        draws = [i * self.count + k for k in range(self.count)]
        for k in range(len(self.episodes)):  # the drawn episode or, under 'skip', the next usable one
            episode = int(self.episodes[(at + k) % len(self.episodes)])
            try:
                images = self.source.frames(
                    episode, self.image_key, lambda n: [random_below(n, d, self.seed) for d in draws], self.size
                )
                return np.stack([fit_image(image, self.size) for image in images])
            except EpisodeError as error:
                self.source.skip(error)
        raise DataError(f"{self.source.name}: none of its {len(self.episodes)} episodes can be read")
