"""One job of the simulator suite: some episodes of one dataset, in a process of its own.

`python -m data_pipelines.simulators JOB`, where JOB is the JSON of a `Job`. Every episode becomes two
files, each written atomically: NUMBER.record, the bytes of its RLDS record, and NUMBER.json, its environment, length,
success and time. A line on stdout says that both are written.
"""

from __future__ import annotations

import json
import time
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

from data_pipelines.simulators.embodiments import get_embodiment
from data_pipelines.simulators.packages import prepare_process
from hma_jax.runtime.files import write_file


@dataclass(frozen=True)
class Job:
    """Some episodes of one dataset. `seed` is that of the whole suite."""

    name: str
    episodes: tuple[int, ...]
    seed: int
    size: int
    directory: str

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        values = json.loads(text)
        return cls(**values | {"episodes": tuple(values["episodes"])})


def episode_seed(name: str, seed: int, index: int) -> int:
    """An episode's own seed: it depends on nothing else in a run."""
    return zlib.crc32(f"{seed}/{name}/{index}".encode())


def record_path(directory: str | Path, index: int) -> Path:
    return Path(directory) / f"{index:06d}.record"


def facts_path(directory: str | Path, index: int) -> Path:
    return Path(directory) / f"{index:06d}.json"


def run_job(job: Job) -> None:
    """Simulates, draws and writes the episodes of `job`."""
    prepare_process()
    from data_pipelines.simulators.backends import open_simulator
    from data_pipelines.simulators.episode import record_episode
    from data_pipelines.simulators.record import encode_episode

    spec = get_embodiment(job.name)
    simulator = open_simulator(spec, job.size)
    for index in job.episodes:
        began = time.perf_counter()
        env = spec.envs[index % len(spec.envs)]
        episode = record_episode(simulator, spec, env, episode_seed(job.name, job.seed, index))
        seconds = time.perf_counter() - began
        facts = {"env": env, "frames": len(episode.frames), "success": episode.success, "seconds": seconds}
        facts["states"] = episode.states.shape[1]
        write_file(facts_path(job.directory, index), json.dumps(facts).encode())
        write_file(record_path(job.directory, index), encode_episode(spec, episode, index))
        print(index, flush=True)
    simulator.close()
