"""Initialisers that depend on the configuration: what muP says of the trunk and of read-outs."""

from __future__ import annotations

from hma_jax.config import ModelConfig
from hma_jax.params import Initializer, xavier_uniform

READOUT_GAIN = 0.01


def trunk_init(config: ModelConfig, fan_in: int, fan_out: int) -> Initializer:
    """Xavier, whose variance falls with the width of either side, as muP wants of hidden matrices.

    DIFFERS: the release's continuous variant draws them from N(0, 0.02) at every width, which is
    `trunk_gain` 0.32 at width 256.
    """
    missing = config.width_multiplier / config.mup_multiplier("init")
    return xavier_uniform(fan_in, fan_out, config.trunk_gain * missing**0.5)


def readout_init(config: ModelConfig, fan_out: int) -> Initializer:
    """Xavier times sqrt(m): a read-out's input is divided by m instead."""
    return xavier_uniform(config.width, fan_out, READOUT_GAIN * config.mup_multiplier("readout") ** 0.5)
