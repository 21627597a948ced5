"""Recorded actions replayed in a learned simulator, batch by batch: a source that `data_pipelines.convert` writes."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.sources.convertible import Episode, Layout, Skipped
from data_pipelines.sources.rlds.writer import encode_jpeg, image_field
from experiments.applications.generating.trajectories import Trajectories, Trajectory, describe, require_layout
from hma_jax.config.json import to_dict
from hma_jax.simulator.interface import AnySimulator
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start
from hma_jax.training.hashes import NAME as HASHES
from hma_jax.training.run_lock import CHECKPOINTS

IMAGE, ACTION = "observation/image", "action"

SHARD_BYTES = 2**21
"""A shard ends with the batch that reaches this size: what a killed run loses at most, some hundred frames."""


class GeneratedSource:
    """Each unit is a batch of B episodes, B those of the simulator. A frame is one step, its action the whole chunk.

    An episode depends on the model, its recorded frames and actions, and the seed that its number and `seed` give.
    """

    def __init__(
        self,
        simulator: Simulator,
        robot: Robot,
        recorded: Trajectories,
        *,
        given: int,
        count: int,
        seed: int,
        checkpoint: str,
    ):
        """`given` first frames are the recording's; the first `count` recordings are replayed; `checkpoint` is the
        model's hash. Raises ConfigError for recordings of the robot with other actions."""
        require_layout(recorded, robot, simulator.model.table)
        self._simulator, self._robot, self._recorded = simulator, robot, recorded
        self._given, self._count, self._seed, self._checkpoint = given, count, seed, checkpoint
        height, width = simulator.tokenizer.image_shape
        chunk = robot.stride * robot.action_dim
        self.layout = Layout({IMAGE: image_field(height, width)}, {ACTION: chunk}, knows_success=False)
        self.hz = recorded.spec.hz / robot.stride  # a run alone may not know how often its robot acts
        self.description = f"{recorded.name} ({recorded.split}) as a model sees it under the recorded actions."
        self.batches = [range(i, min(i + len(simulator), count)) for i in range(0, count, len(simulator))]
        self.units = [f"episodes {b.start} to {b.stop - 1}" for b in self.batches]

    def origin(self) -> dict[str, Any]:
        """What made the dataset: everything that its bytes depend on."""
        return {
            "generated": True,
            "robot": self._robot.name,
            "range": [list(self._robot.low), list(self._robot.high)],  # actions beyond it are clipped
            "stride": self._robot.stride,
            "checkpoint": self._checkpoint,
            "step": self._simulator.model.step,
            "tokenizer": self._simulator.tokenizer.identity,
            "decode": to_dict(self._simulator.decode),
            "actions": describe(self._recorded),
            "episodes": self._count,
            "given_frames": self._given,
            "batch": len(self._simulator),
            "seed": self._seed,
        }

    def identity(self) -> dict[str, Any]:
        return {"format": "generated", **self.origin()}

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        """The episodes of a batch, in order."""
        numbers, kept = self.batches[unit], []
        for i in numbers:
            trajectory = self._recorded[i]
            if len(trajectory) > self._given:
                kept.append((i, confined(trajectory, self._robot)))
            else:
                yield Skipped(f"not longer than the {self._given} frames that a generated episode begins with")
        if not kept:
            return
        seeds = [episode_seed(self._seed, self._recorded.origin(i)) for i, _ in kept]
        made = replay(self._simulator, self._robot, [t for _, t in kept], seeds, self._given)
        for (_, trajectory), seed, frames in zip(kept, seeds, made, strict=True):
            yield Episode(
                f"generated/{trajectory.origin}/seed {seed}",
                {IMAGE: [encode_jpeg(frame) for frame in frames]},
                {ACTION: trajectory.chunks.reshape(len(frames), -1)},
                [trajectory.instruction] * len(frames),
            )


def confined(trajectory: Trajectory, robot: Robot) -> Trajectory:
    """With the actions that the simulator will execute: none outside the robot's recorded range."""
    chunks = robot.clip_to_range(trajectory.chunks, "clip")[0]
    return Trajectory(trajectory.origin, trajectory.images, chunks, trajectory.instruction)


def replay(
    simulator: AnySimulator, robot: Robot, trajectories: Sequence[Trajectory], seeds: Sequence[int], given: int
) -> list[np.ndarray]:
    """For each trajectory (at most B) uint8 [M, H, W, 3]: its first `given` frames, then the simulator's.

    All B episodes advance together until the longest ends, so that one program is compiled for all batches.
    """
    spare = len(simulator) - len(trajectories)
    between = [t.chunks[: given - 1].reshape(-1, robot.action_dim) for t in trajectories]
    starts = [Start(robot.name, t.images[:given], a) for t, a in zip(trajectories, between, strict=True)]
    simulator.reset(starts + starts[:1] * spare, seeds=[*seeds, *[0] * spare])
    frames, rest = [list(t.images[:given]) for t in trajectories], np.array(robot.rest, np.float32)
    for step in range(given - 1, max(map(len, trajectories)) - 1):
        goes = [step < len(t) - 1 for t in trajectories]
        actions = [t.chunks[step] if on else rest for t, on in zip(trajectories, goes, strict=True)]
        seen = simulator.step(actions + [rest] * spare)
        for b, on in enumerate(goes):
            if on:
                frames[b].append(seen[b])
    return [np.stack(f) for f in frames]


def episode_seed(seed: int, origin: str) -> int:
    return zlib.crc32(f"{seed}/{origin}".encode())


def checkpoint_hash(run: Path, step: int) -> str:
    """The hash of all files of a run's checkpoint, as listed beside them; "" for one of a version that made no list."""
    path = run / CHECKPOINTS / str(step) / HASHES
    return str(json.loads(path.read_text())["sha256"]) if path.exists() else ""
