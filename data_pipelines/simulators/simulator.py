"""Robots of public simulators as `TrueSimulator`s. Only robots with a single environment: a `Start` names only a robot
and a seed."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from data_pipelines.simulators.behaviour import Behaviour
from data_pipelines.simulators.embodiments import EMBODIMENTS
from data_pipelines.simulators.episode import Simulator
from data_pipelines.simulators.packages import can_render, prepare_process, require_packages, why_unavailable
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.true_simulator import TrueSimulator
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

PHYSICS = {spec.name: spec for spec in EMBODIMENTS if len(spec.envs) == 1}


def can_simulate(robot: Robot) -> bool:
    """Whether this robot has a true simulator that can run in this process."""
    spec = PHYSICS.get(robot.name)
    return spec is not None and spec.action_dim == robot.action_dim and not why_unavailable([spec]) and can_render()


class PhysicsState(NamedTuple):
    """The state of an episode: the physics, and the number of actions since the start."""

    physics: np.ndarray  # float64 [P]
    actions: int


class PhysicsWorld:
    """One environment, opened at once: one episode at a time, seen in frames of `size`."""

    def __init__(self, spec: SimSpec, size: int):
        """Raises ConfigError if packages are missing, or TensorFlow is loaded in this process."""
        require_packages([spec])
        prepare_process()
        from data_pipelines.simulators.backends import open_simulator

        self.spec = spec
        self.simulator: Simulator = open_simulator(spec, size)
        self._seed, self._reached = 0, False
        self._actions: list[np.ndarray] = []

    def reset(self, seed: int) -> None:
        self.simulator.start(self.spec.envs[0], seed)
        self._seed, self._reached, self._actions = seed, False, []

    def step(self, action: np.ndarray) -> None:
        self._actions.append(np.array(action, np.float64))
        self._reached = self.simulator.step(self._actions[-1])[1]

    def get_state(self) -> PhysicsState:
        return PhysicsState(self.simulator.physics(), len(self._actions))

    def set_state(self, state: PhysicsState) -> None:
        """Returns to an earlier state of this episode. The episode is started again and its actions are repeated: the
        controllers of some robots have state that the physics does not hold."""
        earlier = self._actions[: state.actions]
        self.reset(self._seed)
        for action in earlier:
            self.step(action)

    def render(self) -> np.ndarray:
        return self.simulator.frame()

    def success(self) -> bool:
        """Success as the environment reports it after the last action."""
        return self._reached

    def close(self) -> None:
        self.simulator.close()


class PhysicsSimulator(TrueSimulator[PhysicsWorld]):
    """B episodes, each in an environment of its own; `close` it after use."""

    @staticmethod
    def dims() -> dict[str, int]:
        return {name: spec.action_dim for name, spec in PHYSICS.items()}

    def open_world(self, name: str) -> PhysicsWorld:
        return PhysicsWorld(PHYSICS[name], self.image_size)

    def close_world(self, world: PhysicsWorld) -> None:
        world.close()


def new_seeds(name: str, count: int, seed: int, split: str) -> np.ndarray:
    """int64 [count]: seeds of episodes that no dataset of `hma data sim` has. A larger `count` begins with the same
    seeds."""
    return np.array([zlib.crc32(f"{split}/{seed}/{name}/{i}".encode()) for i in range(count)], np.int64)


def physics_starts(name: str, count: int, frames: int, *, stride: int, image_size: int, seed: int = 0) -> list[Start]:
    """The first `frames` frames, every `stride` native steps, of `count` new episodes under the dataset's behaviour."""
    spec, starts = PHYSICS[name], []
    world = PhysicsWorld(spec, image_size)
    try:
        for number in new_seeds(name, count, seed, "starts"):
            world.reset(int(number))
            sim, rng = world.simulator, np.random.default_rng([int(number), 1])
            behaviour = Behaviour(spec, sim.low, sim.high, sim.rest(), sim.expert(), rng)
            images, actions, reached = [world.render()], [], False
            for _ in range(frames - 1):
                for _ in range(stride):
                    actions.append(behaviour.act(reached))
                    world.step(actions[-1])
                    reached = reached or world.success()
                images.append(world.render())
            acted = np.array(actions, np.float32).reshape(-1, spec.action_dim)
            starts.append(Start(name, np.stack(images), acted, int(number)))
    finally:
        world.close()
    return starts
