"""muP's multipliers moved into the weights: the same model for a program with other multipliers.

Two numbers besides the weights depend on the width: the divisor of the inputs of read-outs (the discrete logits and
actions, the condition of the diffusion heads), and the factor on q.k in attention. A model computes the same with other
numbers if the matrices next to them absorb the ratio. Facts: reference sections 1.5 and 1.7.
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
    """The factor on the weights of read-outs with which `target` computes what `model` does."""
    return target.mup_multiplier("readout") / model.mup_multiplier("readout")


def query_ratio(model: ModelConfig, target: ModelConfig) -> float:
    """The factor on q.k with which `target` computes what `model` does."""
    return attention_scale(model) / attention_scale(target)


def folded(
    arrays: Mapping[str, np.ndarray], leaves: Mapping[str, ParamSpec], model: ModelConfig, target: ModelConfig
) -> dict[str, np.ndarray]:
    """Path -> array: the parameters with which `target` computes what `model` does with `arrays`.

    The two differ only in `mup`. Arrays that need no change are returned as they are, not copied.
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
            # q and k share one norm, so each is multiplied by the square root.
            multiply(f"{layer}/norm/gain", math.sqrt(ratio))
            multiply(f"{layer}/norm/bias", math.sqrt(ratio))
        elif ratio != 1:
            out[f"{layer}/qkv"] = _queries_times(out[f"{layer}/qkv"], ratio)
            if model.qkv_bias:
                out[f"{layer}/qkv_bias"] = _queries_times(out[f"{layer}/qkv_bias"], ratio)
    return out


def _queries_times(qkv: np.ndarray, ratio: float) -> np.ndarray:
    """q, k and v [..., 3, H, I], of which q is multiplied by `ratio`."""
    return np.asarray(qkv) * np.array([ratio, 1, 1], np.float32)[:, None, None]
