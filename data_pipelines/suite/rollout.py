"""Episodes from start to end: a world driven by its behaviour, or by given actions.

Owns the loop and what is remembered of it. A rollout is a pure function of (spec, episodes,
seed) or, when actions are given, of those. Nothing is drawn here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import World


@dataclass(frozen=True)
class Rollout:
    """What happened. The state at step t is the one before action t.

    q [n, T, C], objects [n, T, K, 2], distractors [n, T, J, 2], goals [n, G, 2],
    actions float32 [n, T, A], lengths [n] (steps that count), reached [n] (the first step
    whose action reached the goal; T if none), success [n].
    """

    q: np.ndarray
    objects: np.ndarray
    distractors: np.ndarray
    goals: np.ndarray
    actions: np.ndarray
    lengths: np.ndarray
    reached: np.ndarray

    @property
    def success(self) -> np.ndarray:
        return self.reached < self.lengths


def simulate(spec: EmbodimentSpec, episodes: int, seed: int, actions: np.ndarray | None = None) -> Rollout:
    """Runs `episodes` episodes. With `actions` [n, T, A] these are executed, from the same
    starts, in place of the scripted behaviour."""
    world = World(spec, episodes, np.random.default_rng([seed, 1]))
    behaviour = Behaviour(world, np.random.default_rng([seed, 2]))
    shortest, longest = (round(s * spec.hz) for s in spec.seconds)
    lengths = np.random.default_rng([seed, 3]).integers(shortest, longest + 1, episodes)
    steps = int(longest) if actions is None else actions.shape[1]
    seen: dict[str, list[np.ndarray]] = {"q": [], "objects": [], "distractors": [], "actions": []}
    reached = np.full(episodes, steps)
    for t in range(steps):
        seen["q"].append(world.q.copy())
        seen["objects"].append(world.objects.copy())
        seen["distractors"].append(world.distractors.copy())
        action = behaviour.act() if actions is None else actions[:, t]
        seen["actions"].append(action.astype(np.float32))
        world.step(seen["actions"][-1].astype(np.float64))
        world.done |= spec.task.done(world)
        reached = np.where(world.done, np.minimum(reached, t), reached)
    stacked = {k: np.stack(v, 1) for k, v in seen.items()}
    return Rollout(goals=world.goals, lengths=lengths, reached=reached, **stacked)
