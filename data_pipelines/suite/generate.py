"""Makes the suite: generates the missing datasets in several processes, each atomically.

Bytes depend on the table, scale and seed, not on the number of workers.
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path

from data_pipelines.publishing.files import publish
from data_pipelines.publishing.fingerprint import FINGERPRINT, is_complete
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.sources.rlds.writer import VERSION
from data_pipelines.suite.embodiments import select
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.write import write_dataset
from hma_jax.config import require
from hma_jax.runtime.outputs import make_directory
from hma_jax.runtime.parent import die_with

GENERATOR_VERSION = 8
"""Raise it when simulation, rendering or encoding change: datasets of older versions are then made again.
Committed studies use 8. Left for the next version: starts at which the goal is already reached (`World`), and episodes
that are marked terminal although the clock ends them (`write`)."""

MIN_EPISODES = 8
"""Training episodes of the smallest datasets, at any scale, unless `fewest` says otherwise."""

MAX_EPISODES = 500
"""Training episodes of the largest dataset at scale 1."""

VALIDATION = 24
"""Held-out episodes of every dataset, whatever its size, in a split "val" of their own."""

Progress = Callable[[str, int, int], None]
"""Called with (name of the dataset just finished or found complete, how many are, of how many)."""


def episode_count(spec: EmbodimentSpec, scale: float, fewest: int = MIN_EPISODES) -> int:
    """Training episodes at a scale: the largest dataset has `scale` times as many as at scale 1, the smallest always
    `fewest`, and those in between are stretched evenly in the logarithm."""
    stretch = max(math.log(scale * MAX_EPISODES / fewest) / math.log(MAX_EPISODES / MIN_EPISODES), 0.0)
    return round(fewest * (spec.episodes / MIN_EPISODES) ** stretch)


def fingerprint(
    spec: EmbodimentSpec, scale: float, seed: int, validation: int = VALIDATION, fewest: int = MIN_EPISODES
) -> str:
    """Hash of what the bytes of this dataset depend on, except the versions of numpy (what its random generators draw)
    and of simplejpeg: under other versions a dataset stays in use."""
    text = repr((GENERATOR_VERSION, spec, episode_count(spec, scale, fewest), validation, seed))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def generate_suite(
    root: str | Path,
    *,
    scale: float = 1.0,
    seed: int = 0,
    validation: int = VALIDATION,
    fewest: int = MIN_EPISODES,
    names: Sequence[str] | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes `<root>/<name>/<version>/` for each embodiment; returns these directories.

    `scale` multiplies the size of the largest dataset, `fewest` is the size of the smallest (see `episode_count`); each
    has `validation` held-out episodes besides. Datasets already complete with the same fingerprint are left as they
    are, others are remade; each appears all at once. Raises ConfigError for bad arguments or a root that cannot be
    written.
    """
    require(0 < scale < math.inf, f"suite scale must be positive and finite, got {scale}")
    require(validation >= 1, f"suite validation must be at least 1 episode, got {validation}")
    require(fewest >= 1, f"the smallest number of episodes of a dataset must be at least 1, got {fewest}")
    require(workers >= 1, f"suite workers must be at least 1, got {workers}")
    specs, root = select(names), Path(root)
    make_directory(root)
    paths = [root / spec.name / VERSION for spec in specs]
    missing, finished = [], 0

    def report(name: str) -> None:
        nonlocal finished
        finished += 1
        if progress:
            progress(name, finished, len(specs))

    for spec, path in zip(specs, paths, strict=True):
        if is_complete(path, fingerprint(spec, scale, seed, validation, fewest)):
            report(spec.name)
        else:
            missing.append(spec)
    # The longest first.
    missing.sort(key=lambda s: -(episode_count(s, scale, fewest) + validation) * s.hz * sum(s.seconds))
    if workers == 1 or len(missing) <= 1:
        for spec in missing:
            _make(spec, root, scale, seed, validation, fewest)
            report(spec.name)
        return paths
    with _processes(min(workers, len(missing))) as pool:
        jobs = {pool.submit(_make, spec, root, scale, seed, validation, fewest): spec.name for spec in missing}
        for job in as_completed(jobs):
            job.result()
            report(jobs[job])
    return paths


@contextmanager
def _processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes that ends at once if an exception, such as Ctrl-C, leaves the block: by itself it would first
    finish all that it was given. What a process leaves half-made is made anew."""
    # Spawned, not forked: the caller may have started threads (JAX has).
    pool = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_enter_process,
        initargs=(os.getpid(),),
    )
    others = set(multiprocessing.active_children())
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    pool.shutdown()


def _enter_process(parent: int) -> None:
    die_with(parent)
    # A terminal sends Ctrl-C to all processes; each would give up one dataset and go on with the next.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _make(spec: EmbodimentSpec, root: Path, scale: float, seed: int, validation: int, fewest: int) -> None:
    """Makes one dataset, unless another process makes it meanwhile."""
    final, expected = root / spec.name / VERSION, fingerprint(spec, scale, seed, validation, fewest)
    with lock_output(final.with_name(f".{VERSION}"), wait=math.inf) as lock:
        if is_complete(final, expected):
            return
        write_dataset(
            spec,
            lock.scratch,
            episodes={"train": episode_count(spec, scale, fewest), "val": validation},
            seed=seed,
            metadata={FINGERPRINT: expected, "generator": GENERATOR_VERSION, "seed": seed, "family": spec.family},
        )
        publish(lock.scratch, final)
