"""A policy in the true world of its task: many episodes side by side, drawn and stepped together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import episode_seeds
from data_pipelines.suite.world import World
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import ReachMark, Task, held
from hma_jax.config import require

SPLIT = "closed loop"
"""Starts of these seeds are in no recording."""

MOST_TRIED = 8
"""Number of starts that are examined for each one that is far enough from its goal."""


class Outcome(NamedTuple):
    """How n episodes went."""

    success: np.ndarray  # bool [n]: the goal was held
    distance: np.ndarray  # float [n]: distance from the goal at the last frame, in halves of the floor's side


def start_seeds(task: Task, count: int, least: float = 0.0) -> np.ndarray:
    """int64 [count]: seeds of starts that are in no recording and at least this far from the goal. A larger `count`
    begins with the same seeds. Raises ConfigError if there are too few."""
    seeds = episode_seeds(task.spec, MOST_TRIED * count, 0, SPLIT)
    far = seeds[start_distances(task, seeds) >= least][:count]
    require(len(far) == count, f"{task.robot}: too few starts are at least {least:g} away from the goal")
    return far


def start_distances(task: Task, seeds: np.ndarray) -> np.ndarray:
    """float [n]: the distance from the goal at which the episodes with these seeds begin."""
    return goal_distance(World(task.spec, seeds))


def run_policy(task: Task, policy: Policy, seeds: np.ndarray, image_size: int, stride: int = 1) -> Outcome:
    """Runs one episode of `task.frames` frames from each start. The first frame is the start, and a goal that is
    reached there counts. A pure function of its arguments."""
    world, looks = World(task.spec, seeds), draw_appearance(task.spec, seeds)
    reached = []
    policy.reset(seeds=[int(seed) % 2**32 for seed in seeds])
    for t in range(task.frames):
        reached.append(world.success())
        if t == task.frames - 1:
            break
        images = render_frames(task.spec, looks, world.goals, world.q, world.objects, np.arange(len(seeds)))
        actions = policy.act(fit_images(images, image_size)).astype(np.float64)
        for i in range(stride):
            world.step(actions[:, i] if actions.ndim == 3 else actions)
    return Outcome(held(np.stack(reached, 1), task.hold).any(1), goal_distance(world))


def goal_distance(world: World) -> np.ndarray:
    """float [n]: the distance from the goal; for a robot's own task, that of the farthest tool from its mark."""
    task = world.spec.task
    if isinstance(task, ReachMark):
        return task.distance(world)
    return np.linalg.norm(world.tools - world.goals, axis=-1).max(1)
