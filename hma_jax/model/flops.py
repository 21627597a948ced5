"""Floating-point operations by formula, and the peak of known devices.

Model FLOPs: two per multiply-add of a matrix product, causal attention counted half, nothing
for recomputation under remat and nothing for element-wise work. XLA's own count is not used:
it counts the body of a scan once.
"""

from __future__ import annotations

import jax

from hma_jax.config import ModelConfig
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.heads import TIME_FEATURES


def forward_flops_per_window(config: ModelConfig, table: EmbodimentTable) -> float:
    """One forward pass over one window of T frames."""
    d, t, p = config.width, config.frames, config.frame_tokens
    attention = 2 * 4 * d * d  # q, k, v and output, spatial and temporal
    mlp = 2 * d * config.mlp_width
    scores = 2 * p * d + 2 * t * d / 2  # logits and weighted values; causal time counts half
    per_token, per_frame = attention + mlp + scores, 0.0
    if "modulate" in config.conditioning:
        per_token += d * d
        per_frame += 3 * d * d  # shift and scale are made once per frame
    elif config.conditioning == "cross_attention":
        per_token += 2 * d * d + 2 * t * d / 2
        per_frame += 2 * d * d
    stem = table.action_width * d + d * d
    trunk = config.layers * (p * per_token + per_frame)
    return 2.0 * t * (trunk + stem + _frame_head_flops(config))


def _frame_head_flops(config: ModelConfig) -> float:
    """Multiply-adds per frame, embedding included. The denoiser is run once on every token."""
    d, diffusion = config.width, config.diffusion
    if diffusion is None:
        return config.tokens * d * config.factors * config.factor_vocab
    w, c = diffusion.width, diffusion.token_channels
    blocks = diffusion.depth * 5 * w * w
    denoiser = (TIME_FEATURES + w + d + c) * w + blocks + 2 * w * w + 2 * w * c
    return config.tokens * (c * d + d * d + diffusion.repeats * denoiser)


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
