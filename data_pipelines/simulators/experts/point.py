"""A ball in an open arena: straight to the goal, with a brake. Actions are forces in -1..1."""

from __future__ import annotations

import numpy as np

from data_pipelines.simulators.behaviour import Expert

GAIN, BRAKE = 0.8, 0.6  # per metre, per metre per second


def expert(backend) -> Expert:
    def act() -> np.ndarray:
        seen = backend.observation
        return GAIN * (seen["desired_goal"] - seen["achieved_goal"]) - BRAKE * seen["observation"][2:4]

    return act
