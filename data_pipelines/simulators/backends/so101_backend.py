"""lerobot-env-so101: a five-joint SO-101 arm that picks a cube and places it."""

from __future__ import annotations

import numpy as np
from lerobot_env_so101 import SO101PickPlaceGymEnv
from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE
from lerobot_env_so101.scripted import PickPlaceController

from data_pipelines.simulators.backends.physics import PhysicsBackend
from data_pipelines.simulators.behaviour import Expert


class Backend(PhysicsBackend):
    def make(self, env: str) -> None:
        self.env = SO101PickPlaceGymEnv(random_block_position=True, action_scale=DEFAULT_ACTION_SCALE)

    def reset(self, seed: int) -> None:
        self.env.reset(seed=seed)
        self.model, self.data = self.env.model, self.env.data
        space = self.env.action_space
        self.low, self.high = space.low.astype(np.float64), space.high.astype(np.float64)

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        _, reward, _, _, info = self.env.step(action)
        return float(reward), bool(info["succeed"])

    def expert(self) -> Expert:
        controller = PickPlaceController()

        def act() -> np.ndarray:
            block = self.data.sensor("block_pos").data.copy()
            return controller.act(self.env.ik_point_pos, block, self.env.goal_pos)

        return act
