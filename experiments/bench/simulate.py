"""A learned simulator as its users step it: actions in, pixels out, tokenizer and host copies included."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.bench.record import Stage
from experiments.bench.timing import time_by_turns, time_once
from experiments.simulators import load_simulator
from hma_jax.config import ExecutionConfig
from hma_jax.config.execution import Dtype


def time_simulator(run: Path, episodes: int, repeats: int, dtype: Dtype = "float32") -> Stage:
    """Stage `step`: `episodes` that advance together past the window, from the run's starts in turn, at rest.

    Raises ConfigError where there is no run, or nothing to start from.
    """
    execution = ExecutionConfig(dtype, remat="none")
    simulator = load_simulator(run, episodes=episodes, execution=execution, history=1)
    starts = [simulator.starts[i % len(simulator.starts)] for i in range(episodes)]
    actions = [np.array(simulator.robots[start.robot].rest, np.float32) for start in starts]
    simulator.reset(starts)
    _, first = time_once(lambda: simulator.step(actions))
    for _ in range(simulator.model.config.frames):
        simulator.step(actions)
    timing = time_by_turns({"step": lambda: simulator.step(actions)}, repeats)["step"]
    return Stage("step", episodes, timing, max(first - timing.median, 0.0), frames=episodes)
