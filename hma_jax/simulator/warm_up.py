"""Everything that a simulator will compile, before somebody waits for it."""

from __future__ import annotations

import numpy as np

from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start


def warm_up(simulator: Simulator) -> None:
    """Begins, rewinds and advances black episodes, as many together as there may be; then all is as before."""
    kept, together = simulator.snapshot(), 0
    robot = next(iter(simulator.robots.values()))
    black = np.zeros((1, *simulator.images.shape[1:]), np.uint8)
    simulator.reset(Start(robot.name, black, np.zeros((0, robot.action_dim), np.float32)))
    simulator.rewind(0)
    action = np.array(robot.rest, np.float32)
    while together < len(simulator):
        together = min(2 * together or 1, len(simulator))
        for _ in range(robot.stride if simulator.rate == "native" else 1):
            simulator.step([action] * together + [None] * (len(simulator) - together))
    simulator.restore(kept)
