"""Which of our models the official release can compute, and in which form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hma_jax.config import ConfigError, MaskingSetting, ModelConfig, MupConfig
from hma_jax.convert.official_config import BASE_WIDTH, NETWORKS, is_continuous
from hma_jax.model.embodiments import EmbodimentTable

ATTENTION_SCALE = 8
"""Under muP the release multiplies q.k by this number divided by the head width."""


def can_hold_mup(model: ModelConfig) -> bool:
    """Whether the release can use the multipliers of this model's muP.

    In the discrete variant it accepts every width. A continuous model of a width other than 256 fails the shape check
    of its muP, because there the condition of the diffusion heads is not a read-out.
    """
    scale = model.mup.attention_scale == ATTENTION_SCALE and "attention" not in model.mup.without
    return scale and (model.diffusion is None or model.width == BASE_WIDTH)


def released_form(model: ModelConfig) -> ModelConfig:
    """The model that the release builds from `model`'s configuration, with action heads and the release's multipliers;
    `multipliers.folded` gives its parameters. muP is off if the release cannot use it."""
    mup = MupConfig(enabled=model.mup.enabled and can_hold_mup(model), base_width=BASE_WIDTH)
    return replace(model, mup=mup, action_heads=True)


def loads_in_release(config: Mapping[str, Any]) -> bool:
    """Whether the release's `from_pretrained` takes this config.json; see `can_hold_mup`."""
    return not (is_continuous(config) and config.get("use_mup") and config["d_model"] != BASE_WIDTH)


def require_official(model: ModelConfig, table: EmbodimentTable, setting: MaskingSetting = "forward") -> None:
    """Raises ConfigError for a model, trained for `setting`, that the release cannot compute."""
    reasons = []
    if setting == "passive":
        reasons.append(
            "train.masking.setting is 'passive': the model sees no actions, but the release's models see all"
        )
    if setting == "inverse":
        reasons.append("train.masking.setting is 'inverse': its attention is not causal, but the release's is")
    if model.action_alignment != "released":
        reasons.append(
            f"model.action_alignment is {model.action_alignment!r}, but the release supports only 'released'"
        )
    if model.conditioning == "cross_attention":
        reasons.append("model.conditioning is 'cross_attention', which the release computes differently")
    elif model.conditioning not in NETWORKS.values():
        reasons.append(f"model.conditioning is {model.conditioning!r}, which the release does not have")
    if model.recall:
        reasons.append("model.recall is true, but masked tokens of the release hold only one learned vector")
    if model.chain_factors:
        reasons.append("model.chain_factors is true, but the release samples a token's factors independently")
    if math.isqrt(model.tokens) ** 2 != model.tokens:
        reasons.append(f"model.tokens {model.tokens} is not a square number, but the release's frames are square")
    if model.diffusion and model.diffusion.steps != 1000:
        reasons.append(f"model.diffusion.steps is {model.diffusion.steps}, but the release supports only 1000")
    for entry in table.entries:
        if "." in entry.name or not entry.name:
            reasons.append(f"the robot's name {entry.name!r} contains a dot, which torch uses to separate module names")
        if entry.chunk == 0:
            reasons.append(f"{entry.name} has no actions, but all robots of the release need some")
    if reasons:
        raise ConfigError("the official format cannot hold this model: " + "; ".join(reasons))
