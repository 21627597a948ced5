"""gym-aloha: two ViperX arms, commanded by absolute joint angles and finger openings."""

from __future__ import annotations

import numpy as np
from gym_aloha.constants import START_ARM_POSE
from gym_aloha.env import AlohaEnv

from data_pipelines.simulators.backends.physics import PhysicsBackend

ARM = 6  # joints, then one gripper
JOINTS = 2 * (ARM + 2)  # of both arms, with two fingers each; they come first in the physics
SPAN = 0.7  # radians that a joint may go from where it starts


class Backend(PhysicsBackend):
    def make(self, env: str) -> None:
        self.env = AlohaEnv(env, obs_type="pixels_agent_pos")
        # Every step draws 640 x 480 pixels for an observation that nobody sees.
        blank = np.zeros((480, 640, 3), np.uint8)
        self.env._env.physics.render = lambda **kwargs: blank

    def reset(self, seed: int) -> None:
        self.env.reset(seed=seed)
        physics = self.env._env.physics
        self.model, self.data = physics.model.ptr, physics.data.ptr
        arm = np.asarray(START_ARM_POSE[:ARM])
        self.low = np.tile(np.append(arm - SPAN, 0.0), 2)
        self.high = np.tile(np.append(arm + SPAN, 1.0), 2)

    def vector(self) -> np.ndarray:
        """The state of the arms alone: one task has one loose object, the other two."""
        return np.concatenate([self.data.qpos[:JOINTS], self.data.qvel[:JOINTS]]).astype(np.float32)

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        _, reward, _, _, info = self.env.step(action)
        return float(reward), bool(info["is_success"])
