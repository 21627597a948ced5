"""Floating-point operations by formula.

Model FLOPs: two per multiply-add of a matrix product, causal attention counted half, nothing
for recomputation under remat and nothing for element-wise work. XLA's own count is not used:
it counts the body of a scan once.
"""

from __future__ import annotations

from hma_jax.config import MaskingConfig, ModelConfig, TrainConfig
from hma_jax.model.conditioning import IN_BLOCKS
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.heads import TIME_FEATURES


def forward_flops_per_window(
    config: ModelConfig, table: EmbodimentTable, masking: MaskingConfig = MaskingConfig()
) -> float:
    """One forward pass over one window of T frames; with latents also the denoisers, evaluated as often as in training.

    With teacher forcing it is a pass over T - 1 frames and, beside them, over the T - 1 that follow them. What
    `masking` does not predict is not computed. An action head without a denoiser is too small to count.

    Two simplifications are kept because published trials were counted this way, and training budgets must stay
    comparable: without teacher forcing all T frames are read out, although training leaves out the first; and attention
    over time is causal, although it is not in the setting `inverse`.
    """
    t, diffusion = config.frames, config.diffusion
    frames, predicted = (2 * (t - 1), t - 1) if masking.teacher_forcing else (t, t)
    predicted = predicted if masking.predicts_frames else 0
    denoisers = 0.0
    if diffusion:
        denoisers = denoiser_flops(config, diffusion.repeats * predicted * config.tokens)
        if masking.predicts_actions:
            denoisers += denoiser_flops(config, t, channels=table.action_width)
    return pass_flops(config, table, frames, t / 2, predicted) + denoisers


def pass_flops(
    config: ModelConfig, table: EmbodimentTable, frames: int, seen: float, predicted: int | None = None
) -> float:
    """One pass over `frames` frames of one window, up to the logits, or the denoiser's conditions, of `predicted` of
    them (None: all).

    `seen`: the number of frames, itself included, that a frame attends to over time, on average; T / 2 in a causal
    window of T.
    """
    predicted = frames if predicted is None else predicted
    d, p = config.width, config.frame_tokens
    attention = 2 * 4 * d * d  # q, k, v and output, spatial and temporal
    mlp = 2 * d * config.mlp_width
    scores = 2 * p * d + 2 * seen * d  # logits and weighted values
    per_token, per_frame = attention + mlp + scores, 0.0
    if config.block_conditioning:
        of_token, per_frame = IN_BLOCKS[config.block_conditioning].multiplications(config, seen)
        per_token += of_token
    stem = table.action_width * d + d * d
    embedding = config.tokens * config.diffusion.token_channels * d if config.diffusion else 0
    outputs = d if config.diffusion else config.factors * config.factor_vocab
    if config.chain_factors:
        outputs += d + (config.factors - 1) * config.factor_vocab
    shared = config.layers * (p * per_token + per_frame) + stem + embedding
    return 2.0 * (frames * shared + predicted * config.tokens * d * outputs)


def denoiser_flops(config: ModelConfig, tokens: int, own_steps: bool = True, channels: int | None = None) -> float:
    """One evaluation of the denoiser on `tokens` tokens; `channels` is given for a denoiser of other vectors, such as
    actions.

    `own_steps`: each token is at a noising step of its own, as in training. In sampling all tokens are at the same
    step; what is computed from it once for all tokens and examples is not counted.
    """
    d, w, c = config.width, config.diffusion.width, channels or config.diffusion.token_channels
    blocks = config.diffusion.depth * 5 * w * w
    time = (TIME_FEATURES + w) * w if own_steps else 0
    return 2.0 * tokens * (time + (d + c) * w + blocks + 2 * w * w + 2 * w * c)


def train_flops_per_step(config: ModelConfig, table: EmbodimentTable, train: TrainConfig) -> float:
    """Forward and backward pass of the global batch: three times the forward pass, and once more for each round of
    `own_past`."""
    passes = 3.0 + (train.masking.own_past_rounds if train.masking.own_past else 0)
    return passes * train.batch * forward_flops_per_window(config, table, train.masking)
