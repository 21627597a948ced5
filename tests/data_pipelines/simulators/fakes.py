"""Episodes nobody simulated, and worker processes that make them."""

from __future__ import annotations

import json

import numpy as np

from data_pipelines.simulators import generate, packages, select
from data_pipelines.simulators.episode import Episode, StartState
from data_pipelines.simulators.record import encode_episode
from data_pipelines.simulators.worker import Job, facts_path, record_path

(SPEC,) = select(["pusht"])
SIZE, EPISODES = 16, 3


def make_episode(index: int, steps: int = 80) -> Episode:
    rng = np.random.default_rng(index)
    return Episode(
        start=StartState("PushT", index, tuple(rng.standard_normal(10).tolist())),
        frames=np.full((steps, SIZE, SIZE, 3), 18 * index, np.uint8),
        states=rng.standard_normal((steps, 10)).astype(np.float32),
        actions=rng.uniform(0, 512, (steps, 2)).astype(np.float32),
        rewards=rng.random(steps).astype(np.float32),
        success=index == 1,
    )


def write_episode(directory, index: int) -> None:
    episode = make_episode(index)
    facts = {"env": "PushT", "frames": 80, "success": episode.success, "seconds": 2.0, "states": 10}
    facts_path(directory, index).write_text(json.dumps(facts))
    record_path(directory, index).write_bytes(encode_episode(SPEC, episode, index))


class FakeProcess:
    """Stands for a worker process: makes its episodes, or dies on the way."""

    made: list[int] = []
    dies_at: tuple[int, ...] = ()

    def __init__(self, command, stdout, stderr, env, text):
        job = Job.from_json(command[-1])
        self.code, lines = 0, []
        for i in job.episodes:
            if i in self.dies_at:
                stderr.write(b"cannot draw\n")
                stderr.flush()
                self.code = -11
                break
            write_episode(job.directory, i)
            self.made.append(i)
            lines.append(f"{i}\n")
        self.stdout = iter(lines)

    def wait(self) -> int:
        return self.code


def fake_workers(monkeypatch) -> type[FakeProcess]:
    """Simulations of `pusht` are fakes; `made` lists their episodes, `dies_at` names those that fail."""
    FakeProcess.made, FakeProcess.dies_at = [], ()
    monkeypatch.setattr(generate.subprocess, "Popen", FakeProcess)
    monkeypatch.setattr(generate, "require_packages", lambda specs: None)
    monkeypatch.setattr(packages.importlib.metadata, "version", lambda name: "1.0")
    return FakeProcess
