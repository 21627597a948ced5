"""A tiny world for tests: three robots, a model of a few thousand parameters, random windows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jax
import numpy as np

from hma_jax.config import DiffusionConfig, ExecutionConfig, ModelConfig, MupConfig, OptimizerConfig, TrainConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.objective.masking import mask_batch

TABLE = EmbodimentTable(
    (
        Embodiment("pusher", 2, 1, (0.0, 1.0), (1.0, 2.0)),
        Embodiment("arm", 7, 2, (0.5,) * 7, (0.1,) * 7),
        Embodiment("base", 3, 3, (0.0,) * 3, (1.0, 0.0, 3.0)),
    )
)


DIFFUSION = DiffusionConfig(channels=2, patch=2, width=16, depth=2, steps=20)
"""The continuous variant: model_config(diffusion=DIFFUSION)."""


def model_config(**changes) -> ModelConfig:
    settings = dict(
        width=32,
        layers=2,
        heads=4,
        frames=6,
        tokens=9,
        action_tokens=2,
        factors=2,
        factor_vocab=8,
        mup=MupConfig(base_width=32),
    )
    return ModelConfig(**(settings | changes))


def shallow_config(**changes) -> ModelConfig:
    """One layer, where what a second one adds is compilation."""
    return model_config(**{"layers": 1} | changes)


SMALLER = dict(width=8, layers=1, heads=2, frames=3, tokens=4, action_tokens=1, factor_vocab=4)
"""model_config(**SMALLER): where what is computed does not matter. Tests that share it share its compiled step."""


def train_config(**changes) -> TrainConfig:
    settings = dict(steps=6, batch=8, optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=2))
    return TrainConfig(**(settings | changes))


def in_float64(execution: ExecutionConfig = ExecutionConfig()) -> ExecutionConfig:
    """The same in float64, which users cannot choose: for comparisons that rounding must not disturb."""
    made = dataclasses.replace(execution)
    object.__setattr__(made, "dtype", "float64")
    return made


mask = jax.jit(mask_batch, static_argnums=(3, 4, 5))
"""`mask_batch` as one program: by itself it is a hundred."""


def random_batch(seed: int, config: ModelConfig, batch: int = 8, table=TABLE) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (batch, config.frames)
    embodiment = rng.integers(0, table.size, batch, dtype=np.int32)
    actions = rng.normal(size=(*shape, table.action_width)).astype(np.float32)
    for row, index in enumerate(embodiment):
        actions[row, :, table.entries[index].chunk :] = 0
    tokens = rng.integers(0, config.vocab_size, (*shape, config.tokens), dtype=np.int32)
    if config.diffusion:
        size = (*shape, config.tokens, config.diffusion.token_channels)
        tokens = rng.normal(size=size).astype(np.float32)
    return {
        "tokens": tokens,
        "actions": actions,
        "embodiment": embodiment,
    }


def batches(config: ModelConfig, batch: int = 8) -> Callable[[int], Iterator[dict[str, np.ndarray]]]:
    """make_batches(start): an endless stream that is a function of the step."""

    def make(start: int) -> Iterator[dict[str, np.ndarray]]:
        step = start
        while True:
            yield random_batch(step, config, batch)
            step += 1

    return make


def lively_params(config: ModelConfig, table=TABLE, scale: float = 0.2):
    """(declarations, parameters away from their start, where much is zero or tiny)."""
    declared = declare_model(config, table)
    params = declared.init(0)
    rng = np.random.default_rng(2)  # not jax.random, which compiles a program for every shape

    def moved(x: jax.Array) -> jax.Array:
        return jax.device_put(np.asarray(x) + scale * rng.standard_normal(x.shape, dtype=np.float32))

    return declared, jax.tree.map(moved, params)
