"""OGBench's own oracles: closed-loop scripts for cubes, buttons, drawers and windows."""

from __future__ import annotations

import numpy as np
from ogbench.manipspace.oracles.markov.button_markov import ButtonMarkovOracle
from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
from ogbench.manipspace.oracles.markov.drawer_markov import DrawerMarkovOracle
from ogbench.manipspace.oracles.markov.window_markov import WindowMarkovOracle

from data_pipelines.simulators.behaviour import Expert

ORACLES = {
    "cube": CubeMarkovOracle,
    "button": ButtonMarkovOracle,
    "drawer": DrawerMarkovOracle,
    "window": WindowMarkovOracle,
}


def expert(backend) -> Expert:
    """The oracle of the task that the environment has just drawn."""
    oracle = ORACLES[backend.info["privileged/target_task"]](env=backend.env)
    oracle.reset(backend.observation, backend.info)

    def act() -> np.ndarray:
        return oracle.select_action(backend.observation, backend.info)

    return act
