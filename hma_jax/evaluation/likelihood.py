"""How well a model's outputs fit the frames that were recorded: the loss of a window."""

from __future__ import annotations

import jax

from hma_jax.evaluation.metrics import factored_cross_entropy, mean_over_frames
from hma_jax.model.hma import HMA
from hma_jax.objective.losses import frame_diffusion_loss


def window_loss(
    model: HMA, token_outputs: jax.Array, truth: jax.Array, key_B: jax.Array | None, real_BT: jax.Array | None
) -> jax.Array:
    """Mean loss of each window [B] over the frames `truth` [B, T, S (, C)] that are `real_BT` (None: all), given the
    model's outputs for these frames: cross-entropy of ids, or diffusion loss with noise drawn with `key_B`."""
    if model.config.diffusion:
        return mean_over_frames(frame_diffusion_loss(model, token_outputs, truth, key_B, training=False), real_BT)
    return mean_over_frames(factored_cross_entropy(model.logits(token_outputs, truth), truth), real_BT)
