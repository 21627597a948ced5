"""Makes the simulator suite: simulates the missing episodes in several processes and publishes whole datasets.

Bytes depend on the table, the packages' versions, frame size, number of episodes and seed; not on the number of
workers or on interruptions. Finished episodes are kept, and a dataset appears when all of its episodes are finished.
One process at a time makes a dataset (see `publishing`). Imports no simulator.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from data_pipelines.errors import MAX_LISTED, DataError
from data_pipelines.publishing.fingerprint import FINGERPRINT, is_complete, read_metadata, shard_lengths
from data_pipelines.publishing.output_lock import OutputLock, lock_output
from data_pipelines.simulators.embodiments import select
from data_pipelines.simulators.packages import gl_backend, package_versions, require_packages
from data_pipelines.simulators.record import IMAGE_KEY
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.simulators.worker import Job, record_path
from data_pipelines.simulators.write import write_dataset
from data_pipelines.sources.rlds.schema import read_features
from data_pipelines.sources.rlds.writer import VERSION
from hma_jax.config import require
from hma_jax.runtime.outputs import make_directory

GENERATOR_VERSION = 2
"""Raise it when simulation, behaviour, rendering or encoding change: datasets of older versions are then recognised
(`made_by_other_versions`)."""

JOB_EPISODES = 10
"""Episodes per process, at most: starting a process costs a few seconds."""

Progress = Callable[[str, int, int], None]
"""Called with (dataset, finished episodes, total episodes), both over all datasets."""


def fingerprint(spec: SimSpec, episodes: int, size: int, seed: int) -> str:
    """Hash of everything the bytes of this dataset depend on."""
    text = repr((GENERATOR_VERSION, spec, episodes, size, seed, package_versions(spec), gl_backend()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differences(spec: SimSpec, directory: Path, episodes: int, size: int, seed: int) -> list[str] | None:
    """Which settings of the existing dataset differ from those asked for; [] if only the versions of the packages or of
    the generator differ. None if nothing differs, or if there is no complete dataset, so that one is made in any
    case."""
    if not directory.exists():
        return None
    metadata = read_metadata(directory)
    made_as = metadata.get(FINGERPRINT)
    if made_as is None:
        return ["it does not say how it was made"]
    if made_as == fingerprint(spec, episodes, size, seed) or not is_complete(directory, made_as):
        return None
    existing = {
        "episodes": sum(shard_lengths(directory)),
        "size": read_features(directory)[f"steps/observation/{IMAGE_KEY}"].shape[0],
        "seed": metadata.get("seed"),
    }
    wanted = {"episodes": episodes, "size": size, "seed": seed}
    return [f"{name}: {existing[name]} -> {value}" for name, value in wanted.items() if existing[name] != value]


def made_by_other_versions(root: Path, specs: Sequence[SimSpec], episodes: int, size: int, seed: int) -> list[str]:
    """Datasets that exist with the settings asked for, made by other versions of the packages or of the generator.

    Raises ConfigError for one that was made with other settings or by another program: it is not replaced.
    """
    found = {s.name: differences(s, root / s.name / VERSION, episodes, size, seed) for s in specs}
    lines = [f"{root / name / VERSION}: {'; '.join(how)}" for name, how in found.items() if how]
    more = f" and {len(lines) - MAX_LISTED} more" if len(lines) > MAX_LISTED else ""
    require(
        not lines,
        "datasets exist that were made with other settings (there -> asked for): "
        f"{', '.join(lines[:MAX_LISTED])}{more}. Nothing was changed. Choose another directory, use the settings that "
        "they were made with, or remove them to make them again.",
    )
    return [name for name, how in found.items() if how is not None]


def generate_sim(
    root: str | Path,
    *,
    names: Sequence[str] | None = None,
    episodes: int = 20,
    size: int = 128,
    seed: int = 0,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes `<root>/<name>/<version>/` for each embodiment; returns these directories.

    `episodes` per dataset, frames of `size` x `size`. Complete datasets with the same fingerprint are left as they are;
    those that other versions of the packages or the generator made are replaced. Raises ConfigError for bad arguments,
    missing packages, what `made_by_other_versions` refuses and a dataset that another process is making, DataError if a
    simulator fails; the other datasets are made nevertheless.
    """
    require(episodes >= 1, f"episodes must be at least 1, got {episodes}")
    require(16 <= size <= 1024, f"the frame size must lie in 16..1024, got {size}")
    require(workers >= 1, f"workers must be at least 1, got {workers}")
    specs, root = select(names), Path(root)
    require_packages(specs)
    made_by_other_versions(root, specs, episodes, size, seed)
    make_directory(root)
    fingerprints = {spec.name: fingerprint(spec, episodes, size, seed) for spec in specs}
    with ExitStack() as locks:
        run = _Run(root, fingerprints, episodes, size, seed, progress, locks)
        jobs = [job for spec in specs for job in run.plan(spec)]
        failures = run.work(jobs, workers)
    if failures:
        raise DataError(
            f"{len(failures)} of {len(specs)} datasets could not be made; the others are complete. "
            + " ".join(failures.values())
            + " The same command tries them again."
        )
    return [root / spec.name / VERSION for spec in specs]


@dataclass
class _Run:
    """One call of `generate_sim`: what is finished, and the running processes."""

    root: Path
    fingerprints: Mapping[str, str]
    episodes: int
    size: int
    seed: int
    progress: Progress | None
    stack: ExitStack  # holds the locks of datasets
    done: int = 0  # episodes
    stopped: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)
    finishing: threading.Lock = field(default_factory=threading.Lock)
    children: set[subprocess.Popen] = field(default_factory=set)
    output_locks: dict[str, OutputLock] = field(default_factory=dict)

    def staging(self, name: str) -> Path:
        """The directory in which the episodes of an unfinished dataset are collected."""
        return self.root / name / f".{VERSION}.episodes.{self.fingerprints[name]}"

    def plan(self, spec: SimSpec) -> list[Job]:
        """The jobs that a dataset still needs; if there are none, the dataset is finished here."""
        name = spec.name
        if not is_complete(self.root / name / VERSION, self.fingerprints[name]):
            lock = lock_output(self.root / name / f".{VERSION}", called=self.root / name)
            self.output_locks[name] = self.stack.enter_context(lock)  # until the whole run ends
        if is_complete(self.root / name / VERSION, self.fingerprints[name]):  # another process may have made it by then
            self.count(name, self.episodes)
            return []
        staging = self.staging(name)
        staging.mkdir(parents=True, exist_ok=True)
        missing = self.missing(name)
        self.count(name, self.episodes - len(missing))
        if not missing:
            self.finish(spec)
        chunks = [missing[i : i + JOB_EPISODES] for i in range(0, len(missing), JOB_EPISODES)]
        return [Job(name, tuple(chunk), self.seed, self.size, str(staging)) for chunk in chunks]

    def missing(self, name: str) -> list[int]:
        return [i for i in range(self.episodes) if not record_path(self.staging(name), i).is_file()]

    def work(self, jobs: Sequence[Job], workers: int) -> dict[str, str]:
        """Runs `jobs`. Returns one message for each dataset for which a job failed. If it is interrupted, its processes
        are ended."""
        with ThreadPoolExecutor(workers) as pool:
            running = {pool.submit(self.run, job): job.name for job in jobs}
            try:
                outcomes = [(running[job], job.result()) for job in as_completed(running)]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                self.stop()
                raise
        return dict(sorted((name, failure) for name, failure in outcomes if failure))

    def run(self, job: Job) -> str:
        """Runs one process. Returns a message if it failed, "" if not."""
        log = Path(job.directory) / "log.txt"
        with open(log, "ab") as messages:
            child = self.launch(job, messages)
            for line in child.stdout:
                if line.strip().isdigit():  # packages print other lines
                    self.count(job.name, 1)
            code = child.wait()
        with self.lock:
            self.children.discard(child)
        if code:
            last = log.read_text(errors="replace").strip().splitlines()[-1:] or ["no message"]
            return f"{job.name}: its simulator ended with exit code {code}: {last[0]} (the full output is in {log})."
        with self.finishing:
            (spec,) = select([job.name])
            if self.staging(job.name).is_dir() and not self.missing(job.name):
                self.finish(spec)
        return ""

    def launch(self, job: Job, messages: BinaryIO) -> subprocess.Popen:
        command = [sys.executable, "-m", "data_pipelines.simulators", job.to_json()]
        here = str(Path(__file__).parents[2])
        path = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
        # One thread each: several processes share the cores.
        environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
        with self.lock:
            if self.stopped:
                raise KeyboardInterrupt
            child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=messages, env=environment, text=True)
            self.children.add(child)
        return child

    def stop(self) -> None:
        with self.lock:
            self.stopped = True
            for child in self.children:
                child.kill()

    def finish(self, spec: SimSpec) -> None:
        """Assembles a dataset from its episodes."""
        write_dataset(
            spec,
            self.root / spec.name,
            self.output_locks[spec.name],
            self.staging(spec.name),
            episodes=self.episodes,
            size=self.size,
            metadata={FINGERPRINT: self.fingerprints[spec.name], "generator": GENERATOR_VERSION, "seed": self.seed},
        )

    def count(self, name: str, episodes: int) -> None:
        with self.lock:
            self.done += episodes
            if self.progress:
                self.progress(name, self.done, len(self.fingerprints) * self.episodes)
