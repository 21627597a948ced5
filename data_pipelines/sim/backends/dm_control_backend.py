"""dm_control: its suite as `domain-task`, its manipulation tasks as `manipulation/name`."""

from __future__ import annotations

import numpy as np
from dm_control import manipulation, suite

from data_pipelines.sim.backends.physics import PhysicsBackend


class Backend(PhysicsBackend):
    def reset(self, env: str, seed: int) -> None:
        group, _, name = env.rpartition("/")
        if group == "manipulation":
            self.env = manipulation.load(name, seed=seed)
            self.env._time_limit = np.inf
        else:
            domain, _, task = env.partition("-")
            self.env = suite.load(domain, task, task_kwargs={"random": seed, "time_limit": np.inf})
        self.env.reset()
        self.model, self.data = self.env.physics.model.ptr, self.env.physics.data.ptr
        spec = self.env.action_spec()
        self.low, self.high = np.array(spec.minimum, np.float64), np.array(spec.maximum, np.float64)

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        step = self.env.step(action)
        self.env._reset_next_step = False  # the clock of the dataset ends episodes
        return float(step.reward or 0.0), False
