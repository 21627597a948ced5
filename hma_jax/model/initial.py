"""Initialisers that depend on the configuration: what muP prescribes for each role."""

from __future__ import annotations

from hma_jax.config import ModelConfig
from hma_jax.model.params import Initializer, xavier_uniform

READOUT_GAIN = 0.01


def hidden_init(config: ModelConfig, fan_in: int, fan_out: int, gain: float) -> Initializer:
    """Xavier, whose variance falls with the width of either side, as muP requires for hidden matrices."""
    missing = config.width_multiplier / config.mup_multiplier("init")
    return xavier_uniform(fan_in, fan_out, gain * missing**0.5)


def trunk_init(config: ModelConfig, fan_in: int, fan_out: int) -> Initializer:
    """The initialiser of a hidden matrix of the trunk.

    DIFFERS: the release's continuous variant draws these from N(0, 0.02) at every width, which for
    square matrices of width 256 is `trunk_gain` 0.32.
    """
    return hidden_init(config, fan_in, fan_out, config.trunk_gain)


def input_fan_out(config: ModelConfig) -> float:
    """The fan-out that Xavier uses for a matrix whose input has a fixed size.

    DIFFERS: it is the base width at every width, so that entries stay as large as those of biases and embeddings,
    which learn at the same rate. The release uses the true width, so features shrink as 1 / sqrt(D).
    """
    return config.width / config.mup_multiplier("init")


def readout_init(config: ModelConfig, fan_out: int) -> Initializer:
    """Xavier of the base width at every width: a read-out's input is divided by m instead.

    DIFFERS: the release multiplies Xavier of the true width by sqrt(m), which is the same only where
    the width is far above `fan_out`.
    """
    return xavier_uniform(config.width / config.mup_multiplier("readout"), fan_out, READOUT_GAIN)
