"""Loading: training windows from a token store, frames from RLDS shards, and the memory used meanwhile."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.loading.loader import make_loader
from data_pipelines.loading.selection import LoaderConfig
from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.splits import HeldOut
from data_pipelines.tokens.dataset_writer import cut_parts, write_dataset
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.manifest import JobSettings, Manifest, SplitFacts, TokenizerFacts
from data_pipelines.tokens.store import TokenStore
from experiments.bench.record import Stage
from experiments.bench.timing import summarise

if TYPE_CHECKING:
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.rlds.location import Location

DATASETS, EPISODES, STEPS = 40, 20, 200
"""Size of the store that is made when none is given: forty robots, 2 to 28 action values, 10 Hz."""

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

        write_dataset(root, plan, cut_parts([1] * EPISODES, EPISODES), episodes)
    return TokenStore(root)


@dataclass(frozen=True)
class MemoryPoint:
    """A row of memory.csv."""

    stage: str
    drawn: int  # windows or frames so far
    resident_bytes: int


@dataclass(frozen=True)
class LoadTiming:
    """What drawing batches took: the timing of one batch, and memory over time."""

    stage: Stage
    memory: tuple[MemoryPoint, ...]

    @property
    def slope(self) -> float:
        """Bytes per thousand drawn, over the second half: caches fill in the first."""
        late = self.memory[len(self.memory) // 2 :]
        drawn, size = ([getattr(p, name) for p in late] for name in ("drawn", "resident_bytes"))
        return 1000 * float(np.polyfit(drawn, size, 1)[0])

    def describe(self) -> str:
        drawn = self.memory[-1].drawn
        return f"memory over {drawn:,} {self.stage.name}: {self.slope / 1e3:+.1f} kB per thousand"


def time_windows(store: TokenStore, windows: int, batch: int, frames: int, threads: int) -> LoadTiming:
    """`windows` training windows; a call is a batch."""
    config = LoaderConfig(batch=batch, frames=frames)
    loader = make_loader(store, store.embodiment_table(store.names, config.rate), config, threads=threads)
    return _drain(loader, _with_threads("windows", threads), max(windows // batch, 20), batch, batch * frames)


def time_shards(
    sources: Sequence[tuple[DatasetSpec, Location | Parts]], frames: int, batch: int, size: int, threads: int
) -> LoadTiming:
    """The same for single frames of RLDS shards, decoded and resized to `size` pixels."""
    loader = make_frame_loader(sources, size, batch, 0, tau=LoaderConfig.tau, held_out=HeldOut(), threads=threads)
    return _drain(loader, _with_threads("RLDS frames", threads), max(frames // batch, 20), batch, batch)


def _with_threads(what: str, threads: int) -> str:
    return f"{what}, {threads} thread{'s' * (threads != 1)}"


def _drain(loader: Iterator[Any], name: str, batches: int, batch: int, frames: int) -> LoadTiming:
    for _ in range(10):
        next(loader)
    seconds, memory = [], []
    for number in range(batches):
        began = time.perf_counter()
        next(loader)
        seconds.append(time.perf_counter() - began)
        memory.append(MemoryPoint(name, (number + 1) * batch, resident_bytes()))
    # The mean is what counts: a batch that was ready costs nothing, and the next one more.
    timing = replace(summarise(seconds), median=float(np.mean(seconds)))
    return LoadTiming(Stage(name, batch, timing, frames=frames), tuple(memory))


def plot_memory(timings: Sequence[LoadTiming], path: Path) -> None:
    """Resident memory over what was drawn, a panel per stage."""
    from experiments.report.plot_style import COLOURS, STYLE, plt, save

    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(timings), figsize=(4.3 * len(timings), 3.2), layout="constrained", squeeze=False
        )
        for panel, one in zip(panels[0], timings, strict=True):
            drawn, size = ([getattr(p, name) for p in one.memory] for name in ("drawn", "resident_bytes"))
            panel.plot([d / 1e3 for d in drawn], [s / 2**20 for s in size], color=COLOURS["perplexity"])
            panel.set_ylim(0, 1.2 * max(size) / 2**20)
            panel.set_xlabel(f"thousand {one.stage.name}")
            panel.set_ylabel("resident memory (MiB)")
            panel.set_title(f"{one.slope / 1e3:+.1f} kB per thousand", fontsize=9)
        save(figure, path)


def resident_bytes() -> int:
    """Resident memory of this process now, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
