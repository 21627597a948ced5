"""Rollouts under many sequences of actions at once, in the learned simulator or in the true one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import State, World
from experiments.simulators import START_FRAMES
from hma_jax.config import require
from hma_jax.simulator.interface import require_frame_steps
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

log = logging.getLogger(__name__)


class Model(Protocol):
    """A dynamics model that a planner can roll out."""

    def observe(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State) -> None:
        """Sets the state to roll out from: after frames uint8 [H, W, 3] with the actions between them, [A] or whole
        chunks. A learned model uses these, the true one the `state`."""
        ...

    def imagine(self, actions: np.ndarray) -> np.ndarray:
        """uint8 [B, F, H, W, 3]: the frames that follow under actions [B, F, A], each held for a frame, in raw units.
        May be called again, from the same observed state."""
        ...


class LearnedModel:
    """A simulator of B episodes, all of them copies of one that has seen the last `START_FRAMES` frames.

    All candidates use the same random numbers, so that they differ only in their actions. If tokens or latents are
    sampled, these numbers are a function of `seed`, which is the episode's, and of the number of frames observed.
    Greedy decoding draws only the order in which tokens are unmasked: it is the same in all episodes and searches.
    """

    def __init__(self, simulator: Simulator, robot: Robot, seed: int = 0):
        """Raises ConfigError for a simulator of native actions."""
        require_frame_steps(simulator, "planning")
        self._simulator, self._robot, self._seed = simulator, robot, seed
        self._greedy = (simulator.decode.sampler if simulator.tokenizer.channels else simulator.decode).greedy
        self._present = None
        self._warned = False

    def observe(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State | None) -> None:
        """As in `Model`. Warns once of actions that lie outside the robot's range; they are used as they are. Raises
        ConfigError unless there is an action between each two images."""
        del state
        require(
            len(images) == len(actions) + 1,
            f"{len(images)} images with {len(actions)} actions between them: there must be an action between each two "
            "images, so one fewer than images",
        )
        seen = np.stack(images[-START_FRAMES:])
        chunks = [self._robot.chunk(action) for action in actions[len(actions) + 1 - len(seen) :]]
        between = np.concatenate(chunks) if chunks else np.zeros((0, self._robot.action_dim), np.float32)
        self._warn_once(between)
        drawn = int(np.random.default_rng([self._seed, len(images)]).integers(2**32))
        seed = len(seen) if self._greedy else drawn
        self._simulator.reset(Start(self._robot.name, seen, between), seeds=[seed] * len(self._simulator))
        self._present = self._simulator.snapshot()

    def _warn_once(self, observed: np.ndarray) -> None:
        _, beyond = self._robot.clip_to_range(observed, "clip")
        if beyond.any() and not self._warned:
            self._warned = True
            said = self._robot.describe(beyond, observed)
            log.warning("%s: observed %s; are these its raw units? (this is said once)", self._robot.name, said)

    def imagine(self, actions: np.ndarray) -> np.ndarray:
        require(self._present is not None, "nothing was observed yet: call observe before imagine, or before a plan")
        self._simulator.restore(self._present)
        return np.stack([self._simulator.step(list(actions[:, t])) for t in range(actions.shape[1])], axis=1)


class TrueModel:
    """The true dynamics, which no planner has outside a simulator: an upper bound for learned models."""

    def __init__(self, spec: EmbodimentSpec, robot: Robot, image_size: int):
        self._spec, self._robot, self._size = spec, robot, image_size
        self._state: State | None = None

    def observe(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State) -> None:
        del images, actions
        self._state = state

    def imagine(self, actions: np.ndarray) -> np.ndarray:
        count, frames = actions.shape[:2]
        world = World(self._spec, self._state.seeds)
        world.state = self._state.take(np.zeros(count, int))
        q, objects = [], []
        for t in range(frames):
            for _ in range(self._robot.stride):
                world.step(actions[:, t].astype(np.float64))
            q.append(world.q.copy())
            objects.append(world.objects.copy())
        looks = draw_appearance(self._spec, self._state.seeds)
        flat = [np.stack(x, 1).reshape(count * frames, *x[0].shape[1:]) for x in (q, objects)]
        images = render_frames(self._spec, looks, self._state.goals, *flat, np.zeros(count * frames, int))
        images = fit_images(images, self._size)
        return images.reshape(count, frames, *images.shape[1:])
