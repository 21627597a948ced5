"""Floating-point operations by formula, and the peak of known devices.

Model FLOPs: two per multiply-add of a matrix product, causal attention counted half, nothing
for recomputation under remat and nothing for element-wise work. XLA's own count is not used:
it counts the body of a scan once.
"""

from __future__ import annotations

import jax

from hma_jax.config import ModelConfig
from hma_jax.embodiments import EmbodimentTable


def forward_flops_per_window(config: ModelConfig, table: EmbodimentTable) -> float:
    """One forward pass over one window of T frames."""
    d, t, p = config.width, config.frames, config.frame_tokens
    attention = 2 * 4 * d * d  # q, k, v and output, spatial and temporal
    modulation = d * d
    mlp = 2 * d * config.mlp_width
    scores = 2 * p * d + 2 * t * d / 2  # logits and weighted values; causal time counts half
    per_token = attention + modulation + mlp + scores
    per_frame = p * per_token + 3 * d * d  # shift and scale are made once per frame
    stem = table.action_width * d + d * d
    readout = config.tokens * d * config.factors * config.factor_vocab
    return 2.0 * t * (config.layers * per_frame + stem + readout)


def train_flops_per_window(config: ModelConfig, table: EmbodimentTable) -> float:
    """Forward and backward: three times the forward pass."""
    return 3.0 * forward_flops_per_window(config, table)


PEAK_BF16_FLOPS = {
    "NVIDIA H100": 989e12,
    "NVIDIA H200": 989e12,
    "NVIDIA A100": 312e12,
    "TPU v4": 275e12,
    "TPU v5 lite": 197e12,
    "TPU v5p": 459e12,
    "TPU v6 lite": 918e12,
}
"""Dense bf16 peak per device by the start of its kind, from the makers' data sheets."""


def peak_flops() -> float | None:
    """Of all this program's devices together; None where the kind is unknown (CPUs)."""
    kind = jax.devices()[0].device_kind
    for prefix, peak in PEAK_BF16_FLOPS.items():
        if kind.startswith(prefix):
            return peak * jax.device_count()
    return None
