"""A tiny simulator: three robots, images of 8 x 8 pixels, a model and a tokenizer that have learnt nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from hma_jax.config import (
    DecodeConfig,
    DiffusionConfig,
    ExecutionConfig,
    PixelsConfig,
    TokenizerConfig,
    TrainConfig,
)
from hma_jax.model.hma import declare_model
from hma_jax.simulator import Robot, Simulator, Start
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.tokenizers.pixels import PixelTokenizer
from hma_jax.training.runs import Model, Run
from tests.tiny import SMALLER, TABLE, lively_params, model_config

TOKENIZER = TokenizerConfig(image_size=8, downsample=4, bits=4, factors=2, channels=8, decoder_blocks=1)
CONFIG = model_config(**SMALLER | {"frames": 4}, action_alignment="causal")
DECODE = DecodeConfig(2, temperature=1.0)
ROBOTS = tuple(Robot.of(entry) for entry in TABLE.entries)


@lru_cache
def parts() -> tuple[Model, LfqTokenizer]:
    tokenizer = LfqTokenizer(TOKENIZER, declare_tokenizer(TOKENIZER).init(0))
    declared, params = lively_params(CONFIG, scale=0.8)
    run = Run(CONFIG, TrainConfig(), TABLE, params, 7, {"tokenizer": tokenizer.identity})
    return Model(run, declared, ExecutionConfig()), tokenizer


@lru_cache
def latent_parts() -> tuple[Model, PixelTokenizer]:
    """The same robots and images, and a model on latents."""
    tokenizer = PixelTokenizer(PixelsConfig(image_size=8, patch=4))
    config = replace(CONFIG, diffusion=DiffusionConfig(channels=3, patch=4, width=16, depth=1, steps=20))
    declared = declare_model(config, TABLE)
    params = declared.init(0)
    run = Run(config, TrainConfig(), TABLE, params, 7, {"tokenizer": tokenizer.identity})
    return Model(run, declared, ExecutionConfig()), tokenizer


def simulator(**options: Any) -> Simulator:
    return Simulator(*parts(), **{"decode": DECODE, **options})


def start(robot: int, frames: int, seed: int = 0) -> Start:
    """Random frames and actions within range."""
    entry, rng = ROBOTS[robot], np.random.default_rng([robot, seed])
    images = rng.integers(0, 256, (frames, 8, 8, 3), np.uint8)
    return Start(entry.name, images, actions(robot, (frames - 1) * entry.stride, rng))


def actions(robot: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, A] within the robot's range."""
    entry = ROBOTS[robot]
    return rng.uniform(entry.low, entry.high, (count, entry.action_dim)).astype(np.float32)


def chunks_of(robot: int, count: int, seed: int = 9) -> np.ndarray:
    """[count, stride, A]"""
    entry = ROBOTS[robot]
    rng = np.random.default_rng([robot, seed])
    return actions(robot, count * entry.stride, rng).reshape(count, entry.stride, entry.action_dim)
