"""One policy in one world, with the same starts and seeds in each: images, and what the state says about them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from data_pipelines.suite.simulator import SuiteSimulator
from data_pipelines.true_simulator import TrueSimulator
from experiments.applications.policies.learning import Report
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import AnyTask, Task, join, world_of
from experiments.simulators import START_FRAMES, true_starts, true_worlds
from hma_jax.config import ConfigError, require
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.simulator.interface import AnySimulator, require_frame_steps
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

STARTS_SEED = 2
"""Seed of the suite whose held-out episodes are the starts: neither trained on (0) nor used by `ship` (1)."""


@dataclass(frozen=True)
class Rollout:
    """M episodes of L frames; the first frame is the last one of the start.

    images uint8 [M, L, H, W, 3]; reached bool [M, L] by state, all False if there is no state; seconds: of the steps
    only, without the policy; actions float32 [M, L - 1, A], or [M, L - 1, stride, A] for a policy that gives whole
    chunks.
    """

    images: np.ndarray
    actions: np.ndarray
    reached: np.ndarray
    seconds: np.ndarray


def make_starts(task: Task, count: int, size: int, stride: int) -> list[Start]:
    """`count` beginnings of held-out episodes of the task's robot at which its goal is not reached yet."""
    dim = task.spec.action_dim if task.in_suite else task.physics.action_dim
    robot = Robot(task.robot, stride, (-1.0,) * dim, (1.0,) * dim, (0.0,) * dim)
    with closing(true_worlds([robot], image_size=size)) as simulator:
        for times in (1, 2, 4, 8, 16, 32):
            chosen = []
            for start in true_starts(robot, times * count, START_FRAMES, size, seed=STARTS_SEED):
                simulator.reset(start)
                if not _reached(simulator, task)[0]:
                    chosen.append(start)
                if len(chosen) == count:
                    return chosen
    raise ConfigError(f"{task.robot}: in too many held-out episodes the goal is already reached at the start")


def run(
    simulator: AnySimulator,
    policy: Policy,
    starts: Sequence[Start],
    seeds: Sequence[int],
    task: AnyTask,
    *,
    shuffled: bool = False,
    report: Report = lambda done, total, note: None,
) -> Rollout:
    """Runs every start once, as many at a time as the simulator has episodes.

    `shuffled`: what the policy does in one episode is executed in the next one of the same batch, a control that
    should succeed no more often than chance. Raises ConfigError for a simulator of native actions.
    """
    require_frame_steps(simulator, "a rollout")
    parts, batch = [], len(simulator)
    require(len(starts) % batch == 0, f"the number of starts, {len(starts)}, is not a multiple of the batch, {batch}")
    for first in range(0, len(starts), batch):
        part = slice(first, first + batch)
        parts.append(_run(simulator, policy, starts[part], seeds[part], task, shuffled))
        report(first + batch, len(starts), "")
    return join(parts)


def _run(
    simulator: AnySimulator,
    policy: Policy,
    starts: Sequence[Start],
    seeds: Sequence[int],
    task: AnyTask,
    shuffled: bool,
) -> Rollout:
    policy.reset(seeds=seeds)
    images = [simulator.reset(list(starts), seeds=list(seeds)).copy()]
    states = [_reached(simulator, task)]
    acted, seconds = [], 0.0
    for _ in range(task.frames):
        actions = policy.act(images[-1])
        executed = np.roll(actions, 1, axis=0) if shuffled else actions
        acted.append(executed)
        began = time.perf_counter()
        images.append(simulator.step(list(executed)).copy())
        seconds += time.perf_counter() - began
        states.append(_reached(simulator, task))
    shown, done = np.stack(images, 1), np.stack(states, 1)
    return Rollout(shown, np.stack(acted, 1), done, np.full(len(shown), seconds / len(shown)))


def _reached(simulator: AnySimulator, task: AnyTask) -> np.ndarray:
    if isinstance(simulator, SuiteSimulator):
        return world_of(task.spec, [simulator.state(b) for b in range(len(simulator))]).success()
    return simulator.success() if isinstance(simulator, TrueSimulator) else np.zeros(len(simulator), bool)


def save_rollout(rollout: Rollout, path: Path) -> None:
    """Writes the rollout, completely or not at all."""
    write_arrays(path, vars(rollout))


def load_rollout(path: Path) -> Rollout:
    """Loads a rollout. Raises ConfigError for a damaged file."""
    with reading_arrays(path, "remove it; the same command then makes it again") as arrays:
        return Rollout(**{f.name: arrays[f.name] for f in fields(Rollout)})
