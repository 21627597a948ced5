"""Loading: training windows out of a token store, frames out of RLDS shards, and memory meanwhile."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.loading.loader import LoaderConfig, make_loader
from data_pipelines.registry import DatasetSpec
from data_pipelines.tokens.dataset_writer import cut_parts, write_dataset
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.manifest import JobSettings, Manifest, SplitFacts, TokenizerFacts
from data_pipelines.tokens.store import TokenStore
from experiments.bench.record import Stage
from experiments.bench.timing import summarise

DATASETS, EPISODES, STEPS = 40, 20, 200
"""Of the store that is made when none is given: forty robots, 2 to 28 action values, 10 Hz."""

FACTS = TokenizerFacts("drawn", 256, 16, 256, 2**18, 2, 512)


def make_store(root: Path, seed: int) -> TokenStore:
    """A token store of random ids, as large and as mixed as a study's."""
    for d in range(DATASETS):
        dim = 2 + d * 26 // (DATASETS - 1)
        spec = DatasetSpec(f"robot_{d:02d}", "observation/image", ("action",), (dim,), 10.0)
        plan = Manifest(
            spec, FACTS, JobSettings(frame_step=spec.stride), f"{seed}", "1", (), (), SplitFacts(), SplitFacts()
        )

        def episodes(part, d=d, dim=dim, stride=spec.stride) -> Iterator[tuple[str, StoredEpisode]]:
            for i in part.episodes:
                rng = np.random.default_rng([seed, d, i])
                tokens = rng.integers(0, FACTS.vocab_size, (-(-STEPS // stride), FACTS.tokens)).astype(np.uint32)
                actions = rng.standard_normal((STEPS, dim)).astype(np.float32)
                yield ("val" if i < 2 else "train"), StoredEpisode(i, None, tokens, actions, None)

        write_dataset(root, plan, cut_parts([1] * EPISODES, EPISODES, 1), episodes)
    return TokenStore(root)


def time_windows(store: TokenStore, windows: int, batch: int, frames: int, threads: int) -> tuple[Stage, float]:
    """(stage, bytes of memory per thousand windows) of `windows` training windows; a call is a batch."""
    config = LoaderConfig(batch=batch, frames=frames)
    loader = make_loader(store, store.embodiment_table(store.names), config, threads=threads)
    return _drain(loader, "windows", max(windows // batch, 20), batch, batch * frames)


def time_shards(
    sources: Sequence[tuple[DatasetSpec, Path]], frames: int, batch: int, size: int, threads: int
) -> tuple[Stage, float]:
    """The same for single frames of RLDS shards, decoded and resized to `size` pixels."""
    loader = make_frame_loader(sources, size, batch, 0, threads=threads)
    return _drain(loader, "RLDS frames", max(frames // batch, 20), batch, batch)


def _drain(loader: Iterator[Any], name: str, batches: int, batch: int, frames: int) -> tuple[Stage, float]:
    for _ in range(10):
        next(loader)
    seconds, memory = [], []
    for _ in range(batches):
        began = time.perf_counter()
        next(loader)
        seconds.append(time.perf_counter() - began)
        memory.append(resident_bytes())
    # The mean counts: a batch that was ready costs nothing, the next one more.
    mean = float(np.mean(seconds))
    timing = summarise(seconds)
    half = len(memory) // 2  # caches fill in the first half
    slope = np.polyfit(np.arange(half, len(memory)) * batch / 1000, memory[half:], 1)[0]
    return Stage(name, batch, type(timing)(mean, timing.p90, timing.best, len(seconds)), frames=frames), float(slope)


def resident_bytes() -> int:
    """Of this process, now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    import resource

    return pages * resource.getpagesize()
