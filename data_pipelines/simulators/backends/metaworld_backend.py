"""Meta-World: a Sawyer whose hand moves in x, y, z and grasps; fifty tasks, each with a scripted policy.

The package runs at 80 Hz and moves the hand by up to a centimetre a step. Here that centimetre is
spread over `repeat` steps: the same motion at a speed that a real Sawyer can have.
"""

from __future__ import annotations

import metaworld.env_dict as tasks
import numpy as np
from metaworld.policies import ENV_POLICY_MAP

from data_pipelines.simulators.backends.physics import PhysicsBackend
from data_pipelines.simulators.behaviour import Expert


class Backend(PhysicsBackend):
    low, high = -np.ones(4), np.ones(4)

    def make(self, env: str) -> None:
        self.kind = tasks.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{env}-goal-observable"]

    def reset(self, seed: int) -> None:
        self.env = self.kind(seed=seed)  # this draws the task
        self.env.max_path_length = np.inf
        self.observation, _ = self.env.reset()
        self.model, self.data = self.env.model, self.env.data

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        part = np.append(action[:3] / self.spec.repeat, action[3])
        self.observation, reward, _, _, info = self.env.step(part)
        return float(reward), bool(info["success"])

    def expert(self) -> Expert:
        policy = ENV_POLICY_MAP[self.made]()
        return lambda: policy.get_action(self.observation.copy())  # some policies write into it

    def vector(self) -> np.ndarray:
        return self.observation.astype(np.float32)
