"""Batches for training: windows of many embodiments mixed in every batch.

Owns the global order of training windows. Row r of the global batch of step s is a pure
function of (store, config, s, r): it does not depend on the number of processes, and a run
resumes from its step alone, without iterator state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import grain
import numpy as np

from data_pipelines.sampling.mixture import Mixture, make_mixture
from data_pipelines.sampling.order import ENDLESS, endless_shuffle, random_below, stream_seed
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import WindowSet, cut_actions, cut_tokens, require_windows, train_windows
from hma_jax.config import require
from hma_jax.model.embodiments import EmbodimentTable


@dataclass(frozen=True)
class LoaderConfig:
    """What determines the order of training windows."""

    frames: int = 12  # T
    batch: int = 64  # B, global
    tau: float = 3.0  # datasets are drawn with p ∝ windows^(1/tau)
    seed: int = 0  # of the order and of the subset of trajectories
    max_trajectories: int | None = None  # per dataset
    datasets: tuple[str, ...] = ()  # empty: all of the store
    shuffle_actions: bool = False  # control: actions of another episode

    def __post_init__(self):
        require(self.frames >= 1, f"loader.frames must be at least 1, got {self.frames}")
        require(self.batch >= 1, f"loader.batch must be at least 1, got {self.batch}")
        require(self.tau > 0, f"loader.tau must be positive, got {self.tau}")
        require(
            len(set(self.datasets)) == len(self.datasets),
            f"loader.datasets repeat: {', '.join(self.datasets)}",
        )


@dataclass(frozen=True)
class TrainingWindows:
    """The windows a config draws from, and how often. `too_short` counts episodes per dataset."""

    sets: dict[str, WindowSet]
    mixture: Mixture

    @property
    def too_short(self) -> dict[str, int]:
        return {name: s.too_short for name, s in self.sets.items() if s.too_short}


def select_windows(store: TokenStore, config: LoaderConfig) -> TrainingWindows:
    """Counts windows and weighs datasets. Raises DataError if not one window is left."""
    names = config.datasets or store.names
    sets = {n: train_windows(store, n, config.frames, config.max_trajectories, config.seed) for n in names}
    require_windows(sets)
    counts = {name: len(s) for name, s in sets.items()}
    return TrainingWindows(sets, make_mixture(counts, config.tau, {n: s.shortage() for n, s in sets.items()}))


def make_loader(
    store: TokenStore,
    table: EmbodimentTable,
    config: LoaderConfig,
    *,
    start_step: int = 0,
    process_index: int = 0,
    process_count: int = 1,
    prefetch: int = 2,
    threads: int = 2,
) -> Iterator[dict[str, np.ndarray]]:
    """Endless batches from step `start_step` on.

    A batch: `tokens` int32 [B, T, S] or, latents, float32 [B, T, S, C]; `actions` float32
    [B, T, U] in raw units, zero-padded; `embodiment` int32 [B], index into `table`. Process p of
    n yields rows [p B/n, (p+1) B/n) of the global batch. `threads` read ahead by `prefetch`
    batches each.

    Raises ConfigError for unknown datasets or a batch that does not split, DataError if no
    episode is long enough for one window.
    """
    require(
        process_count >= 1 and config.batch % process_count == 0,
        f"loader.batch {config.batch} does not split over {process_count} processes",
    )
    require(0 <= process_index < process_count, f"process {process_index} of {process_count}")
    selected = select_windows(store, config)
    grids = {store.manifest(name).tokenizer for name in selected.mixture.names}
    require(len(grids) == 1, f"the datasets were tokenised differently: {sorted(map(str, grids))}")
    store.check_table(table, selected.mixture.names)
    streams = [_Stream(store, table, selected.sets[name], config) for name in selected.mixture.names]
    mixed = grain.MapDataset.mix(
        [grain.MapDataset.source(stream) for stream in streams], selected.mixture.weights
    )
    # Batches of B/n rows, of which this process takes every n-th: contiguous rows of the
    # global batch. (Single rows in turn could give each process its own dataset.)
    mine = mixed.batch(config.batch // process_count)[process_index::process_count]
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=max(threads * prefetch, 1))
    iterator = iter(mine.to_iter_dataset(options))
    iterator.set_state({"next_index": start_step})
    return iterator


class _Stream:
    """Endless shuffled windows of one dataset: element i is the i-th window ever drawn."""

    def __init__(self, store: TokenStore, table: EmbodimentTable, windows: WindowSet, config: LoaderConfig):
        self.store, self.windows = store, windows
        self.manifest = store.manifest(windows.name)
        self.embodiment = np.int32(table.index(windows.name))
        self.action_width = table.action_width
        self.shuffle_actions = config.shuffle_actions
        self.order_seed = stream_seed(config.seed, "order", windows.name)
        self.action_seed = stream_seed(config.seed, "shuffled actions", windows.name)

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, i: int) -> dict[str, np.ndarray]:
        windows, frames = self.windows, self.windows.frames
        at = endless_shuffle(i, len(windows), self.order_seed)
        episode, start = windows.locate(at)
        item = self.store.episode(windows.name, "train", episode)
        tokens = cut_tokens(item, start, frames, self.manifest)
        if self.shuffle_actions:
            episode, start = windows.locate(self._other(at, i))
            item = self.store.episode(windows.name, "train", episode)
        actions = cut_actions(item, start, frames, self.manifest, self.action_width)
        return {"tokens": tokens, "actions": actions, "embodiment": self.embodiment}

    def _other(self, at: int, i: int) -> int:
        """A window of another episode, drawn anew on every visit so that no pair can be learnt.

        Windows of one episode overlap: their actions would still tell of this one's.
        """
        first, end = self.windows.siblings(at)
        n = len(self.windows)
        others = n - (end - first)
        if others == 0:  # a single episode: at least not the same window
            return at if n == 1 else (at + 1 + random_below(n - 1, i, self.action_seed)) % n
        return (end + random_below(others, i, self.action_seed)) % n
