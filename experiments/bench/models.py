"""The models that are timed. Weights are random: speed does not depend on their values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from experiments.presets import CPU, CPU_CONTINUOUS
from hma_jax.config import DiffusionConfig, ExecutionConfig, ModelConfig, require
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Declared, Params, inference_params
from hma_jax.runtime.devices import default_device
from hma_jax.runtime.heap_holes import fill_holes_after_compiling

BASE = ModelConfig(action_heads=False)
EXECUTION = ExecutionConfig(remat="products")
MODELS = {
    "base": BASE,
    "xl": replace(BASE, width=1024),
    "base-continuous": replace(BASE, diffusion=DiffusionConfig()),
    "xl-continuous": replace(BASE, width=1024, diffusion=DiffusionConfig()),
    "cpu": CPU.model,
    "cpu-continuous": CPU_CONTINUOUS.model,
}

ROBOT_DIM, ROBOT_STRIDE = 7, 3
"""An arm with a gripper at 6 Hz."""


@dataclass(frozen=True)
class Subject:
    """A model to be timed, with random weights and inputs."""

    config: ModelConfig
    execution: ExecutionConfig
    table: EmbodimentTable
    declared: Declared[HMA]
    params: Params
    seed: int

    @property
    def inference_params(self) -> Params:
        """Parameters, with matrices in the type in which they are used."""
        return inference_params(self.declared, self.params, self.execution.dtype)

    def batch(self, rows: int, frames: int | None = None) -> dict[str, Any]:
        """As `random_batch`."""
        return random_batch(self.config, self.table, rows, frames, self.seed)


def random_batch(
    config: ModelConfig, table: EmbodimentTable, rows: int, frames: int | None = None, seed: int = 0
) -> dict[str, Any]:
    """tokens [B, T, S (, C)], actions [B, T, U], embodiment [B], mixing all robots."""
    rng, frames = np.random.default_rng(seed), frames or config.frames
    shape = (rows, frames, config.tokens)
    if config.diffusion:
        tokens = rng.standard_normal((*shape, config.diffusion.token_channels)).astype(np.float32)
    else:
        tokens = rng.integers(0, config.vocab_size, shape).astype(np.int32)
    actions = rng.standard_normal((rows, frames, table.action_width)).astype(np.float32)
    robots = (np.arange(rows) % table.size).astype(np.int32)
    return jax.device_put({"tokens": tokens, "actions": actions, "embodiment": robots})


def make_table(robots: int) -> EmbodimentTable:
    """A table with this number of identical robots."""
    one = Embodiment("robot", ROBOT_DIM, ROBOT_STRIDE, (0.0,) * ROBOT_DIM, (1.0,) * ROBOT_DIM)
    return EmbodimentTable(tuple(replace(one, name=f"robot_{i}") for i in range(robots)))


def make_shape(
    name: str, robots: int = 1, layers: int | None = None, width: int | None = None
) -> tuple[ModelConfig, EmbodimentTable]:
    """Configuration and robots. Raises ConfigError for a name that is not in the table."""
    require(name in MODELS, f"unknown model {name!r}; known: {', '.join(MODELS)}")
    model = MODELS[name]
    sizes = {"layers": layers or model.layers, "width": width or model.width}
    return replace(model, **sizes), make_table(robots)


def make_subject(
    name: str,
    execution: ExecutionConfig = EXECUTION,
    robots: int = 1,
    seed: int = 0,
    layers: int | None = None,
    width: int | None = None,
) -> Subject:
    """Like `make_shape`, with weights. Holes in the heap are filled after compiling, as in a training run."""
    fill_holes_after_compiling(default_device().platform)
    config, table = make_shape(name, robots, layers, width)
    declared = declare_model(config, table, execution)
    return Subject(config, execution, table, declared, declared.init(seed), seed)
