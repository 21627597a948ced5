"""The scripted expert of the suite, with adjustable noise. It sees the true state, which a learned simulator does not
have, so it can act only in the true simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import World
from experiments.applications.policies.tasks import Task


def make_expert(world: World, seed: int) -> Behaviour:
    """An expert that steers `world` to its task's goal and stays there; its imprecision is the noise of the world's
    spec."""
    return Behaviour(world, np.random.default_rng([seed, len(world), 12]), expert=True)


def noisy(task: Task, noise: float) -> EmbodimentSpec:
    """The task's spec, whose scripted behaviour misses by `noise` of what a joint can do in half a second."""
    return replace(task.spec, noise=noise)
