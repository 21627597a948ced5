"""What would be seen under many sequences of actions at once: in the learned simulator, or in the true one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import State, World
from experiments.applications.simulators import START_FRAMES
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

CONTEXT = START_FRAMES
"""Frames that a plan begins with."""


class Model(Protocol):
    """Where a planner looks ahead."""

    def begin(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State) -> None:
        """The present, after frames uint8 [H, W, 3] and the actions between them, [A] or whole chunks. A model takes of
        all this what a robot could know, or, the true one, the `state` itself."""
        ...

    def imagine(self, actions: np.ndarray) -> np.ndarray:
        """uint8 [B, F, H, W, 3]: the frames that follow under actions [B, F, A], each held for a frame, in raw units.
        May be asked again from the same present."""
        ...


class LearnedModel:
    """A simulator of B episodes, all of them copies of one that has seen the last `CONTEXT` frames.

    Candidates share their seed: what differs between them, their actions have done. So do plans that see as many
    frames: what a planner does depends on what it sees alone.
    """

    def __init__(self, simulator: Simulator, robot: Robot):
        self._simulator, self._robot = simulator, robot
        self._present = None

    def begin(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State | None) -> None:
        del state
        seen = np.stack(images[-CONTEXT:])
        chunks = [self._robot.chunk(action) for action in actions[len(actions) + 1 - len(seen) :]]
        between = np.concatenate(chunks) if chunks else np.zeros((0, self._robot.action_dim), np.float32)
        self._simulator.reset(Start(self._robot.name, seen, between), seeds=[len(images)] * len(self._simulator))
        self._present = self._simulator.snapshot()

    def imagine(self, actions: np.ndarray) -> np.ndarray:
        self._simulator.restore(self._present)
        return np.stack([self._simulator.step(list(actions[:, t])) for t in range(actions.shape[1])], axis=1)


class TrueModel:
    """The robot itself, which no planner outside of a simulator has: the ceiling of what a model can give."""

    def __init__(self, spec: EmbodimentSpec, robot: Robot, image_size: int):
        self._spec, self._robot, self._size = spec, robot, image_size
        self._state: State | None = None

    def begin(self, images: Sequence[np.ndarray], actions: Sequence[np.ndarray], state: State) -> None:
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
