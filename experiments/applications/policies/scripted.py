"""The scripted expert of the suite, with adjustable noise. It sees the true state, so it can act in the true simulator
alone, and there is no such thing in a learned one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.simulator import SuiteSimulator
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import World
from experiments.applications.policies.tasks import Task, world_of


def make_expert(world: World, seed: int) -> Behaviour:
    """Steers `world` to its task's goal and stays there; its imprecision is the noise of the world's spec."""
    return Behaviour(world, np.random.default_rng([seed, len(world), 12]), expert=True)


def noisy(task: Task, noise: float) -> EmbodimentSpec:
    """The task's spec, whose scripted behaviour misses by `noise` of what a joint can do in half a second."""
    return replace(task.spec, noise=noise)


class ScriptedPolicy:
    """The expert as a policy of a true simulator: images are ignored, all episodes are of the task's robot."""

    def __init__(self, task: Task, simulator: SuiteSimulator, noise: float = 0.0, seed: int = 0):
        self.simulator, self.seed, self._spec = simulator, seed, noisy(task, noise)
        self._expert: Behaviour | None = None

    def reset(self, episodes: Sequence[int] | None = None, *, seeds: Sequence[int] | None = None) -> None:
        """Episodes that begin anew inherit what the hand of the one before was about to miss by, no more."""
        if episodes is None:
            self._expert = None

    def act(self, images: np.ndarray) -> np.ndarray:
        world = world_of(self._spec, [self.simulator.state(b) for b in range(len(images))])
        if self._expert is None:
            self._expert = make_expert(world, self.seed)
        self._expert.world = world
        return self._expert.act().astype(np.float32)
