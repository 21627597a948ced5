"""What all MuJoCo backends share: the physics state as a vector, rendering, and the action repeat.

A package's backend gives `reset` and `advance`, and sets `model` and `data`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np

from data_pipelines.simulators.backends.picture import Picture
from data_pipelines.simulators.behaviour import Expert
from data_pipelines.simulators.spec import SimSpec

EVERYTHING = mujoco.mjtState.mjSTATE_INTEGRATION
"""Positions, velocities, activations, controls, mocap bodies, forces, warm starts, time."""


class PhysicsBackend(ABC):
    """A simulator whose state is that of one MuJoCo model."""

    model: mujoco.MjModel
    data: mujoco.MjData
    low: np.ndarray
    high: np.ndarray
    hidden_geoms: tuple[int, ...] = ()

    def __init__(self, spec: SimSpec, size: int):
        self.spec, self.size = spec, size
        self.made = ""  # the environment that is open
        self.picture: Picture | None = None
        self._drawn: mujoco.MjModel | None = None

    # --- of a package ----------------------------------------------------------------------------

    @abstractmethod
    def make(self, env: str) -> None:
        """Opens the environment `env`, always the same one; costs seconds with some packages."""

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Brings the open environment to the start that `seed` means, whatever ran before.

        Sets `model`, `data`, `low` and `high`.
        """

    @abstractmethod
    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        """One step of the environment: (reward, whether the goal is reached)."""

    def expert(self) -> Expert | None:
        return None

    def rest(self) -> np.ndarray:
        return (self.low + self.high) / 2

    def vector(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel]).astype(np.float32)

    # --- shared ----------------------------------------------------------------------------------

    def start(self, env: str, seed: int) -> None:
        if env != self.made:
            np.random.seed(0)  # several packages draw from the global generator
            self.make(env)
            self.made = env
        np.random.seed(seed)
        self.reset(seed)
        if self.model is not self._drawn:
            self.close()
            self.picture = Picture(self.model, self.spec.view, self.size, self.hidden_geoms)
            self._drawn = self.model

    def step(self, action: np.ndarray) -> tuple[float, bool]:
        reward, reached = 0.0, False
        for _ in range(self.spec.repeat):
            more, done = self.advance(action)
            reward, reached = reward + more, reached or done
        return reward, reached

    def physics(self) -> np.ndarray:
        values = np.empty(mujoco.mj_stateSize(self.model, EVERYTHING))
        mujoco.mj_getState(self.model, self.data, values, EVERYTHING)
        return values

    def set_physics(self, values: np.ndarray) -> None:
        # Derived quantities are recomputed only if the state is different: a restored start is then bit for bit the
        # start.
        if not np.array_equal(values, self.physics()):
            mujoco.mj_setState(self.model, self.data, values, EVERYTHING)
            mujoco.mj_forward(self.model, self.data)

    def frame(self) -> np.ndarray:
        return self.picture.draw(self.data)

    def close(self) -> None:
        if self.picture is not None:
            self.picture.close()
            self.picture = None
