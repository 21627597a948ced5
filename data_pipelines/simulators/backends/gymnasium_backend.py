"""Environments with Gymnasium's interface: Gymnasium's own, Gymnasium-Robotics, OGBench."""

from __future__ import annotations

import gymnasium
import gymnasium_robotics
import numpy as np
import ogbench  # noqa: F401 (registers its environments)

from data_pipelines.simulators.backends.physics import PhysicsBackend
from data_pipelines.simulators.behaviour import Expert
from data_pipelines.simulators.experts import fetch, ogbench_oracles, point

gymnasium.register_envs(gymnasium_robotics)

EXPERTS = {"fetch script": fetch.expert, "straight line": point.expert, "oracle": ogbench_oracles.expert}


class Backend(PhysicsBackend):
    def make(self, env: str) -> None:
        self.env = gymnasium.make(env, disable_env_checker=True, **self.spec.kwargs).unwrapped

    def reset(self, seed: int) -> None:
        self.observation, self.info = self.env.reset(seed=seed)
        inner = getattr(self.env, "point_env", self.env).unwrapped
        self.model = inner._model if hasattr(inner, "_model") else inner.model
        self.data = inner._data if hasattr(inner, "_data") else inner.data
        self.low = self.env.action_space.low.astype(np.float64)
        self.high = self.env.action_space.high.astype(np.float64)

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        self.observation, reward, _, _, self.info = self.env.step(action)
        return float(reward), _success(self.info)

    def expert(self) -> Expert | None:
        return EXPERTS[self.spec.expert](self) if self.spec.expert else None

    def vector(self) -> np.ndarray:
        if isinstance(self.observation, dict) and "Fetch" in self.made:
            return self.observation["observation"][:10].astype(np.float32)  # what all its tasks have in common
        proprio = [self.info[key] for key in sorted(self.info) if key.startswith("proprio/")]
        return np.concatenate(proprio).astype(np.float32) if proprio else super().vector()

    def frame(self) -> np.ndarray:
        if hasattr(self.env, "_render_callback"):  # moves the marks of the goal to where it is
            self.env._render_callback()
        return super().frame()


def _success(info: dict) -> bool:
    """Whether an environment says that its goal is reached, under any of the usual keys."""
    done = info.get("success", info.get("is_success", info.get("step_task_completions", False)))
    return bool(len(done)) if isinstance(done, list) else bool(done)
