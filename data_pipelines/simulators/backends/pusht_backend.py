"""gym-pusht: a disc that pushes a T in the plane. Neither MuJoCo nor OpenGL."""

from __future__ import annotations

import numpy as np
from gym_pusht.envs.pusht import PushTEnv

from data_pipelines.simulators.behaviour import Expert
from data_pipelines.simulators.experts import pusht
from data_pipelines.simulators.spec import SimSpec


class Backend:
    low, high = np.zeros(2), np.full(2, 512.0)  # the disc's target, in pixels of the package

    def __init__(self, spec: SimSpec, size: int):
        self.spec, self.size = spec, size

    def start(self, env: str, seed: int) -> None:
        self.env = PushTEnv(obs_type="state", observation_width=self.size, observation_height=self.size)
        self.env.reset(seed=seed)
        self.first = np.array(self.env.agent.position)

    def rest(self) -> np.ndarray:
        return self.first

    def expert(self) -> Expert:
        return pusht.expert(self.env)

    def step(self, action: np.ndarray) -> tuple[float, bool]:
        reward, reached = 0.0, False
        for _ in range(self.spec.repeat):
            _, more, _, _, info = self.env.step(action)
            reward, reached = reward + float(more), reached or bool(info["is_success"])
        return reward, reached

    def physics(self) -> np.ndarray:
        agent, block = self.env.agent, self.env.block
        moving = [*agent.position, *agent.velocity, *block.position, *block.velocity]
        return np.array([*moving, block.angle, block.angular_velocity])

    def set_physics(self, values: np.ndarray) -> None:
        if np.array_equal(values, self.physics()):
            return  # contacts known from the reset stay known
        agent, block = self.env.agent, self.env.block
        agent.position, agent.velocity = tuple(values[0:2]), tuple(values[2:4])
        block.angle, block.angular_velocity = values[8], values[9]
        block.position, block.velocity = tuple(values[4:6]), tuple(values[6:8])
        for body in (agent, block):
            self.env.space.reindex_shapes_for_body(body)

    def vector(self) -> np.ndarray:
        return self.physics().astype(np.float32)

    def frame(self) -> np.ndarray:
        return np.ascontiguousarray(self.env._render(visualize=False))  # without a mark of the action

    def close(self) -> None:
        self.env.close()
