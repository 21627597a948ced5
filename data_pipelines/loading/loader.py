"""Batches for training: windows of many embodiments mixed in every batch.

Owns the global order of training windows. Row r of the global batch of step s is a pure
function of (store, config, s, r): it does not depend on the number of processes, and a run
resumes from its step alone, without iterator state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from data_pipelines.loading.endless import iterate
from data_pipelines.loading.selection import LoaderConfig, TrainingWindows, select_windows
from data_pipelines.sampling.draws import Draws
from data_pipelines.sampling.order import ENDLESS, endless_shuffle, random_below, stream_seed
from data_pipelines.sources.identity import describe
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import WindowSet
from hma_jax.config import require
from hma_jax.model.embodiments import EmbodimentTable

PREFETCH = 2
"""Batches that each thread of a loader makes ahead."""


def make_loader(
    store: TokenStore,
    table: EmbodimentTable,
    config: LoaderConfig,
    *,
    start_step: int = 0,
    rows: Sequence[int] | None = None,
    threads: int = 2,
) -> Iterator[dict[str, np.ndarray]]:
    """Endless batches from step `start_step` on.

    A batch: `tokens` int32 [B, T, S] or, for latents, float32 [B, T, S, C]; `actions` float32 [B, T, U] in raw units,
    zero-padded; `embodiment` int32 [B], index into `table`; `real` bool [B, T], False for frames that only fill up a
    window of a short episode. `rows`: the wanted rows of the global batch, in their order: each of several processes
    takes its own (`hma_jax.runtime.rows`). Each of the `threads` prefetches PREFETCH batches.

    Raises ConfigError for unknown datasets or rows, DataError if no episode is long enough for one window.
    """
    wanted = np.arange(config.batch) if rows is None else np.asarray(rows, np.int64)
    require(
        len(wanted) > 0 and 0 <= wanted.min() and wanted.max() < config.batch,
        f"rows {wanted.tolist()} are not in a batch of {config.batch} rows",
    )
    selected = select_windows(store, config)
    names = selected.mixture.names
    grids = {store.manifest(name).tokenizer for name in names}
    require(len(grids) == 1, f"the datasets were tokenised with different tokenizers: {sorted(map(str, grids))}")
    store.check_table(table, names, config.rate)
    batches = _WindowBatches(store, table, selected, config, wanted)
    return iterate(batches, start_step, threads, ahead=max(threads * PREFETCH, 1))


def describe_batch(store: TokenStore, table: EmbodimentTable, config: LoaderConfig, step: int) -> list[str]:
    """The windows of the global batch of `step` (from 0 on), row by row: dataset, file and episode, first frame.

    Raises what `make_loader` raises.
    """
    return _WindowBatches(store, table, select_windows(store, config), config, np.arange(config.batch)).describe(step)


class _WindowBatches:
    """Element s: `rows` of the global batch of step s."""

    def __init__(
        self,
        store: TokenStore,
        table: EmbodimentTable,
        selected: TrainingWindows,
        config: LoaderConfig,
        rows: np.ndarray,
    ):
        sets = [selected.sets[name] for name in selected.mixture.names]
        self._streams = [_WindowStream(store, table, windows, config) for windows in sets]
        self._draws = Draws(selected.mixture.weights, config.seed)
        self._lengths = np.asarray([len(windows) for windows in sets])
        self._seeds = np.asarray([stream_seed(config.seed, "order", windows.name) for windows in sets])
        self._batch, self._rows = config.batch, rows

    def __len__(self) -> int:
        return ENDLESS // self._batch

    def __getitem__(self, step: int) -> dict[str, np.ndarray]:
        rows = [self._streams[d].read(i, at) for d, i, at in self._chosen(step)]
        return {key: np.stack([row[key] for row in rows]) for key in rows[0]}

    def describe(self, step: int) -> list[str]:
        return [self._streams[d].describe(at) for d, _, at in self._chosen(step)]

    def _chosen(self, step: int) -> Iterator[tuple[int, int, int]]:
        """(dataset, number of earlier draws from it, window) of every row."""
        dataset, draw = self._draws.at(step * self._batch + self._rows)
        window = endless_shuffle(draw, self._lengths[dataset], self._seeds[dataset])
        return zip(dataset.tolist(), draw.tolist(), window.tolist(), strict=True)


class _WindowStream:
    """The windows of one dataset, as rows of a batch."""

    def __init__(self, store: TokenStore, table: EmbodimentTable, windows: WindowSet, config: LoaderConfig):
        self.store, self.windows = store, windows
        self.embodiment = np.int32(table.index(windows.name))
        self.action_width = table.action_width
        self.shuffle_actions = config.shuffle_actions
        self.action_seed = stream_seed(config.seed, "shuffled actions", windows.name)

    def describe(self, at: int) -> str:
        """Where window `at` was read from, for people to read."""
        episode, start = self.windows.locate(at)
        manifest = self.store.manifest(self.windows.name)
        number = manifest.train.episodes[episode]
        place = describe(manifest.runs, number) if manifest.runs else f"episode {number}"
        return f"{self.windows.name}: {place}, from frame {start * manifest.frame_step}"

    def read(self, i: int, at: int) -> dict[str, np.ndarray]:
        """Window `at`, the i-th ever drawn of this dataset."""
        windows, slicer = self.windows, self.windows.slicer
        episode, start = windows.locate(at)
        item = self.store.episode(windows.name, "train", episode)
        row = {
            "tokens": slicer.tokens(item, start),
            "embodiment": self.embodiment,
            "real": slicer.real_mask(item, start),
        }
        if self.shuffle_actions:
            episode, start = windows.locate(self._other(at, i))
            item = self.store.episode(windows.name, "train", episode)
        actions = slicer.chunks(item.actions, start, self.action_width)
        if self.shuffle_actions:  # the chunks of a shorter window are repeated, so that every real frame has a chunk
            actions = actions[np.arange(slicer.frames) % slicer.count_real(item, start)] * row["real"][:, None]
        return row | {"actions": actions}

    def _other(self, at: int, i: int) -> int:
        """A window of another episode, drawn anew on every visit so that no pair can be learned.

        Not one of the same episode: windows of an episode overlap, so their actions would still carry information.
        """
        first, end = self.windows.episode_range(at)
        n = len(self.windows)
        others = n - (end - first)
        if others == 0:  # if there is a single episode: at least not the same window
            return at if n == 1 else (at + 1 + random_below(n - 1, i, self.action_seed)) % n
        return (end + random_below(others, i, self.action_seed)) % n
