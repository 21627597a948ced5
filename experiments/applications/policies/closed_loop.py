"""A policy in the true world of its task: many episodes side by side, drawn and stepped together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from data_pipelines.sources.rlds.images import fit_image
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import episode_seeds
from data_pipelines.suite.world import World
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import Task, held

SPLIT = "closed loop"
"""Starts of these seeds are in no recording."""


class Outcome(NamedTuple):
    """How n episodes went."""

    success: np.ndarray  # bool [n]: the goal was held
    distance: np.ndarray  # float [n]: from tool to mark at the last frame, in halves of the floor's side


def start_seeds(task: Task, count: int, seed: int = 0) -> np.ndarray:
    """int64 [count]: of starts that no recording has. More of them begin with the same ones."""
    return episode_seeds(task.spec, count, seed, SPLIT)


def run_policy(task: Task, policy: Policy, seeds: np.ndarray, image_size: int, stride: int = 1) -> Outcome:
    """One episode of `task.frames` frames from each start. A function of its arguments."""
    world, looks = World(task.spec, seeds), draw_appearance(task.spec, seeds)
    reached = []
    policy.reset(seeds=[int(seed) % 2**32 for seed in seeds])
    for t in range(task.frames):
        reached.append(world.success())
        if t == task.frames - 1:
            break
        images = render_frames(task.spec, looks, world.goals, world.q, world.objects, np.arange(len(seeds)))
        if images.shape[1] != image_size:
            images = np.stack([fit_image(image, image_size) for image in images])
        actions = policy.act(images).astype(np.float64)
        for _ in range(stride):
            world.step(actions)
    return Outcome(held(np.stack(reached, 1), task.hold).any(1), gap(world))


def gap(world: World) -> np.ndarray:
    """float [n]: how far the farthest tool is from its mark."""
    return np.linalg.norm(world.tools - world.goals, axis=-1).max(1)
