"""dm_control: its suite as `domain-task`, its manipulation tasks as `manipulation/name`."""

from __future__ import annotations

import numpy as np
from dm_control import manipulation, suite

from data_pipelines.simulators.backends.physics import PhysicsBackend


class Backend(PhysicsBackend):
    def make(self, env: str) -> None:
        self.group, _, self.task = env.rpartition("/")

    def reset(self, seed: int) -> None:
        # Made anew for every episode: this is cheap, and the constructor takes the seed.
        if self.group == "manipulation":
            self.env = manipulation.load(self.task, seed=seed)
            self.env._time_limit = np.inf
        else:
            domain, _, task = self.task.partition("-")
            self.env = suite.load(domain, task, task_kwargs={"random": seed, "time_limit": np.inf})
        self.env.reset()
        self.model, self.data = self.env.physics.model.ptr, self.env.physics.data.ptr
        spec = self.env.action_spec()
        self.low, self.high = np.array(spec.minimum, np.float64), np.array(spec.maximum, np.float64)

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        step = self.env.step(action)
        self.env._reset_next_step = False  # the clock of the dataset ends episodes
        return float(step.reward or 0.0), False
