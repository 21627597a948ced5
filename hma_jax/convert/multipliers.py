"""muP's multipliers moved into the weights: the same model for a program that multiplies otherwise.

Two numbers beside the weights scale with the width: what divides the inputs of read-outs (the discrete
logits and actions, the condition of the diffusion heads), and what multiplies q.k in attention. A model
computes the same under other numbers if the matrices next to them take up the ratio. Facts: reference
sections 1.5 and 1.7.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hma_jax.config import ModelConfig
from hma_jax.model.attention import attention_scale
from hma_jax.model.params import ParamSpec

ATTENTION = ("trunk/blocks/space", "trunk/blocks/time")


def readout_ratio(model: ModelConfig, target: ModelConfig) -> float:
    """What read-outs are multiplied by so that `target` computes what `model` does."""
    return target.mup_multiplier("readout") / model.mup_multiplier("readout")


def query_ratio(model: ModelConfig, target: ModelConfig) -> float:
    """What q.k is multiplied by so that `target` computes what `model` does."""
    return attention_scale(model) / attention_scale(target)


def folded(
    arrays: Mapping[str, np.ndarray], leaves: Mapping[str, ParamSpec], model: ModelConfig, target: ModelConfig
) -> dict[str, np.ndarray]:
    """Path -> parameters with which `target` computes what `model` does with `arrays`.

    The two differ in `mup` only. Values that need no change are handed on, not copied.
    """
    out = dict(arrays)

    def multiply(path: str, factor: float) -> None:
        if path in out and factor != 1:
            out[path] = np.asarray(out[path]) * np.float32(factor)

    for path, spec in leaves.items():
        if spec.role == "output":
            multiply(path, readout_ratio(model, target))
    ratio = query_ratio(model, target)
    for layer in ATTENTION:
        if model.qk_norm:
            # One norm is behind q and k: each takes the square root.
            multiply(f"{layer}/norm/gain", math.sqrt(ratio))
            multiply(f"{layer}/norm/bias", math.sqrt(ratio))
        elif ratio != 1:
            out[f"{layer}/qkv"] = _queries_times(out[f"{layer}/qkv"], ratio)
            if model.qkv_bias:
                out[f"{layer}/qkv_bias"] = _queries_times(out[f"{layer}/qkv_bias"], ratio)
    return out


def _queries_times(qkv: np.ndarray, ratio: float) -> np.ndarray:
    """[..., 3, H, I] of q, k and v, of which the first is multiplied."""
    return np.asarray(qkv) * np.array([ratio, 1, 1], np.float32)[:, None, None]
