"""Rollouts of whole episodes under the scripted behaviour, or under given actions.

Owns the loop and what is recorded. A rollout is a pure function of (spec, seeds) and, if given, the actions. Nothing
is rendered here.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import World


@dataclass(frozen=True)
class Rollout:
    """What happened. The state at step t is the one before action t.

    q [n, T, C], objects [n, T, K, 2], goals [n, M, 2], actions float32 [n, T, A], lengths [n]
    (steps that count), reached [n] (the first step whose action reached the goal; T if none),
    seeds [n], success [n].
    """

    q: np.ndarray
    objects: np.ndarray
    goals: np.ndarray
    actions: np.ndarray
    lengths: np.ndarray
    reached: np.ndarray
    seeds: np.ndarray

    @property
    def success(self) -> np.ndarray:
        return self.reached < self.lengths


def episode_seeds(spec: EmbodimentSpec, count: int, seed: int, split: str = "train") -> np.ndarray:
    """int64 [count]: the seeds of a split's episodes. A larger `count` begins with the same seeds."""
    return zlib.crc32(f"{seed}/{spec.name}/{split}".encode()) * 2**20 + np.arange(count, dtype=np.int64)


def episode_lengths(spec: EmbodimentSpec, seeds: Sequence[int]) -> np.ndarray:
    """int64 [n]: native steps, uniform in their logarithm between the spec's bounds."""
    low, high = np.log(spec.seconds)
    draws = np.array([np.random.default_rng([seed, 3]).random() for seed in seeds])
    return np.round(np.exp(low + draws * (high - low)) * spec.hz).astype(np.int64)


def simulate(spec: EmbodimentSpec, seeds: Sequence[int], actions: np.ndarray | None = None) -> Rollout:
    """Runs the episodes with these seeds. If `actions` [n, T, A] are given, they are executed from the same starts in
    place of the scripted behaviour: an episode's own actions reproduce it exactly."""
    world = World(spec, seeds)
    behaviour = Behaviour(world, np.random.default_rng([int(seeds[0]), len(seeds), 2]))
    lengths = episode_lengths(spec, seeds)
    steps = int(lengths.max()) if actions is None else actions.shape[1]
    lengths = np.minimum(lengths, steps)
    seen: dict[str, list[np.ndarray]] = {"q": [], "objects": [], "actions": []}
    reached = np.full(len(seeds), steps)
    for t in range(steps):
        seen["q"].append(world.q.copy())
        seen["objects"].append(world.objects.copy())
        action = behaviour.act() if actions is None else actions[:, t]
        seen["actions"].append(action.astype(np.float32))
        world.step(seen["actions"][-1].astype(np.float64))
        reached = np.where(world.success(), np.minimum(reached, t), reached)
    stacked = {k: np.stack(v, 1) for k, v in seen.items()}
    return Rollout(goals=world.goals, lengths=lengths, reached=reached, seeds=np.asarray(seeds), **stacked)
