"""Experts and play in the true simulator of a task: what was seen, done and reached, for whole batches of episodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from data_pipelines.simulators.behaviour import OrnsteinUhlenbeck
from data_pipelines.simulators.simulator import PhysicsWorld, new_seeds
from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import episode_seeds
from data_pipelines.suite.world import World
from experiments.applications.policies.scripted import make_expert, noisy
from experiments.applications.policies.tasks import Task

JITTER = 2.0
"""Correlation time, in frames, of the errors of a physics simulator's expert."""


class ExpertRollouts(NamedTuple):
    """n episodes of F frames; action t is given at frame t and held until the next."""

    images: np.ndarray  # uint8 [n, F, H, W, 3]
    actions: np.ndarray  # float32 [n, F, A], raw
    reached: np.ndarray  # bool [n, F]: the goal is reached at this frame


def new_episodes(task: Task, count: int, seed: int, split: str) -> np.ndarray:
    """int64 [count]: the seeds of a split's episodes. A larger `count` begins with the same seeds."""
    if task.in_suite:
        return episode_seeds(task.spec, count, seed, split)
    return new_seeds(task.robot, count, seed, split)


def drive(task: Task, seeds: np.ndarray, stride: int, image_size: int, *, noise: float, play: bool) -> ExpertRollouts:
    """Runs `task.frames` frames from each start; a pure function of the arguments. An action is held for `stride`
    native steps."""
    kind = _drive_suite if task.in_suite else _drive_physics
    return kind(task, seeds, stride, image_size, noise, play)


def _drive_suite(
    task: Task, seeds: np.ndarray, stride: int, image_size: int, noise: float, play: bool
) -> ExpertRollouts:
    world = World(noisy(task, noise), seeds)
    rng = np.random.default_rng([int(seeds[0]), len(seeds), 13])
    behaviour = Behaviour(world, rng) if play else make_expert(world, int(seeds[0]))
    q, objects, actions, reached = [], [], [], []
    for _ in range(task.frames):
        q.append(world.q.copy())
        objects.append(world.objects.copy())
        reached.append(world.success())
        actions.append(behaviour.act().astype(np.float32))
        for _ in range(stride):
            world.step(actions[-1].astype(np.float64))
    n, frames = len(seeds), task.frames
    flat = [np.stack(x, 1).reshape(n * frames, *x[0].shape[1:]) for x in (q, objects)]
    looks = draw_appearance(world.spec, seeds)
    images = render_frames(world.spec, looks, world.goals, *flat, np.repeat(np.arange(n), frames))
    images = fit_images(images, image_size)
    return ExpertRollouts(images.reshape(n, frames, *images.shape[1:]), np.stack(actions, 1), np.stack(reached, 1))


def _drive_physics(
    task: Task, seeds: np.ndarray, stride: int, image_size: int, noise: float, play: bool
) -> ExpertRollouts:
    """Uses the expert of `hma data sim`, but it looks once per frame, has no lapses, and its errors have a correlation
    time of `JITTER` frames instead of 0.1 s. With `play`, actions wander around rest."""
    spec, world = task.physics, PhysicsWorld(task.physics, image_size)
    shape = len(seeds), task.frames
    images = np.zeros((*shape, image_size, image_size, 3), np.uint8)
    actions, reached = np.zeros((*shape, spec.action_dim), np.float32), np.zeros(shape, bool)
    try:
        for i, seed in enumerate(seeds):
            world.reset(int(seed))
            sim, rng = world.simulator, np.random.default_rng([int(seed), 13])
            expert, half = sim.expert(), (sim.high - sim.low) / 2
            misses = OrnsteinUhlenbeck(spec.action_dim, spec.tau * spec.hz / stride if play else JITTER, rng)
            for t in range(task.frames):
                images[i, t], reached[i, t] = world.render(), world.success()
                planned = sim.rest() if play else expert()
                missed = planned + (spec.gain if play else noise) * half * misses.step()
                actions[i, t] = np.clip(missed, sim.low, sim.high)
                for _ in range(stride):
                    world.step(actions[i, t])
    finally:
        world.close()
    return ExpertRollouts(images, actions, reached)
