"""Recorded actions replayed in a learned simulator, batch by batch: a source that `data_pipelines.convert` writes."""

from __future__ import annotations

import json
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import EpisodeError
from data_pipelines.sources.convertible import Episode, Layout, Skipped
from data_pipelines.sources.rlds.writer import encode_jpeg, image_field
from experiments.applications.generating.trajectories import (
    Readings,
    Trajectories,
    Trajectory,
    describe,
    require_layout,
)
from hma_jax.config.json import to_dict
from hma_jax.simulator.interface import AnySimulator
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start
from hma_jax.training.hashes import NAME as HASHES
from hma_jax.training.run_lock import CHECKPOINTS

IMAGE, ACTION = "observation/image", "action"

GENERATOR_VERSION = 3
"""Raise it when other bytes are generated from the same model and recordings."""

SHARD_BYTES = 2**21
"""A shard ends with the batch that reaches this size: what a killed run loses at most, some hundred frames."""


class ReplayedSource(ABC):
    """Recorded episodes at a robot's rate, for a model that has seen them or is to see them: a frame is one step, its
    action the whole chunk. Each unit is a batch of episodes.

    Subclasses say what the frames are (`_show`) and what else the bytes depend on (`origin`).
    """

    hz: float

    def __init__(
        self,
        robot: Robot,
        recorded: Trajectories,
        image_shape: tuple[int, int],
        *,
        given: int,
        count: int,
        batch: int,
        knows_success: bool,
    ):
        """Takes those of the first `count` recordings that are longer than `given` frames; `knows_success`: all of them
        say whether they succeeded."""
        self._robot, self._recorded, self._given, self._count, self._batch = robot, recorded, given, count, batch
        vectors = {ACTION: robot.stride * robot.action_dim, **recorded.observed}
        self.layout = Layout({IMAGE: image_field(*image_shape)}, vectors, knows_success)
        self.hz = recorded.spec.hz / robot.stride  # a run alone may not know how often its robot acts
        self.batches = [range(i, min(i + batch, count)) for i in range(0, count, batch)]
        self.units = [f"episodes {b.start} to {b.stop - 1}" for b in self.batches]

    def origin(self) -> dict[str, Any]:
        """What made the dataset: everything that its bytes depend on."""
        spec = self._recorded.spec
        angles = {"angles": spec.angles, "angle_form": spec.angle_form, "angle_unit": spec.angle_unit}
        return {
            "version": GENERATOR_VERSION,
            "robot": self._robot.name,
            "range": [list(self._robot.low), list(self._robot.high)],  # actions beyond it are clipped
            "stride": self._robot.stride,
            "action": {
                "shape": [self._robot.stride, self._robot.action_dim],  # of the chunk, which is written row by row
                "values": list(self._robot.dimensions),  # of a row
                "fields": list(spec.action_keys),  # of the recordings
                "rows_per_second": spec.hz,
                **({name: to_dict(x) for name, x in angles.items()} if spec.angles else {}),
            },
            "actions": describe(self._recorded),
            "episodes": self._count,
            "given_frames": self._given,
            "batch": self._batch,
        }

    def identity(self) -> dict[str, Any]:
        return {"format": "generated", "success": self.layout.knows_success, **self.origin()}

    @abstractmethod
    def _show(self, trajectories: Sequence[Trajectory]) -> list[tuple[str, np.ndarray]]:
        """(origin, frames uint8 [M, H, W, 3]) of each of the trajectories of a batch."""

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        """The episodes of a batch, in order."""
        kept: list[tuple[Trajectory, Readings, bool | None]] = []
        for i in self.batches[unit]:
            try:
                one = confined(self._recorded[i], self._robot)
                if len(one) > self._given:
                    kept.append((one, self._recorded.readings(i), self._recorded.outline(i).success))
                else:
                    yield Skipped(
                        f"not longer than the {self._given} recorded frames at the start of a generated episode"
                    )
            except EpisodeError as error:
                yield Skipped(self._recorded.skip(i, error))
        if not kept:
            return
        shown = self._show([one for one, _, _ in kept])
        for (one, readings, success), (origin, frames) in zip(kept, shown, strict=True):
            yield Episode(
                origin,
                {IMAGE: [encode_jpeg(frame) for frame in frames]},
                {ACTION: one.chunks.reshape(len(frames), -1), **readings.observations},
                one.instructions,
                readings.rewards,
                success,
            )


class GeneratedSource(ReplayedSource):
    """The frames after the first `given` ones are a model's, as many episodes at a time as its simulator has.

    An episode depends on the model, its recording, and the seed that its number and `seed` give.
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
        knows_success: bool = False,
    ):
        """`checkpoint` is the model's hash. Raises ConfigError for recordings of the robot with other actions."""
        require_layout(recorded, robot, simulator.model.table)
        shape, batch = simulator.tokenizer.image_shape, len(simulator)
        super().__init__(robot, recorded, shape, given=given, count=count, batch=batch, knows_success=knows_success)
        self._simulator, self._seed, self._checkpoint = simulator, seed, checkpoint
        self.description = f"{recorded.name} ({recorded.split}), generated by a model from the recorded actions."

    def origin(self) -> dict[str, Any]:
        return {
            "generated": True,
            **super().origin(),
            "checkpoint": self._checkpoint,
            "step": self._simulator.model.step,
            "tokenizer": self._simulator.tokenizer.identity,
            "decode": to_dict(self._simulator.decode),
            "seed": self._seed,
        }

    def _show(self, trajectories: Sequence[Trajectory]) -> list[tuple[str, np.ndarray]]:
        seeds = [episode_seed(self._seed, one.origin) for one in trajectories]
        made = replay(self._simulator, self._robot, trajectories, seeds, self._given)
        origins = [f"generated/{one.origin}/seed {seed}" for one, seed in zip(trajectories, seeds, strict=True)]
        return list(zip(origins, made, strict=True))

    def twin(self) -> RecordedTwin:
        """The recordings of the same episodes, in the same layout."""
        return RecordedTwin(
            self._robot, self._recorded, self._simulator.tokenizer.image_shape, given=self._given, count=self._count,
            batch=self._batch, knows_success=self.layout.knows_success,
        )  # fmt: skip


class RecordedTwin(ReplayedSource):
    """All frames are the recording's, in the size and at the rate of a model's: to be mixed with generated ones."""

    def __init__(self, robot: Robot, recorded: Trajectories, image_shape: tuple[int, int], **options: Any):
        super().__init__(robot, recorded, image_shape, **options)
        self.description = f"{recorded.name} ({recorded.split}) as recorded, at the rate and in the size of a model."

    def origin(self) -> dict[str, Any]:
        size = self.layout.images[IMAGE].shape[:2]
        return {"generated": False, **super().origin(), "image": list(size)}

    def _show(self, trajectories: Sequence[Trajectory]) -> list[tuple[str, np.ndarray]]:
        return [(f"recorded/{one.origin}", one.images) for one in trajectories]


def confined(trajectory: Trajectory, robot: Robot) -> Trajectory:
    """With the actions that the simulator will execute: none outside the robot's recorded range."""
    chunks = robot.clip_to_range(trajectory.chunks, "clip")[0]
    return replace(trajectory, chunks=chunks)


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
    """The hash of all files of a run's checkpoint, as listed beside them."""
    return str(json.loads((run / CHECKPOINTS / str(step) / HASHES).read_text())["sha256"])
