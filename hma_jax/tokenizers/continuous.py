"""The continuous tokenizer: the same autoencoder without a quantiser.

Latents are scaled to unit standard deviation, so that a generative model of them needs no tuning to the tokenizer. The
scale is one number, measured on training frames when training ends (the release multiplies its latents by 0.18215 for
the same purpose). It is deliberately the same for all channels: because training adds noise of one size to all of them,
the encoder gives more important channels a larger spread.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import TokenizerConfig, require
from hma_jax.model.params import Params
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer

SCALE_BATCHES = 32
"""The number of batches of training frames on which the scale is measured."""


class ContinuousTokenizer(AutoencoderTokenizer):
    """Tokens are latent vectors: float32 [B, S, C], of unit standard deviation over everything."""

    kind = "continuous"
    ignored = ("quantise", "factors", "entropy_weight", "entropy_temperature", "commitment_weight")
    measured = ("latent_std",)

    def __init__(self, config: TokenizerConfig, params: Params, latent_std: float, *, piece: int | None = None):
        """`latent_std`: the standard deviation of the encoder's own output.

        Raises ConfigError if `params` are not those that `config` declares, or if `latent_std` is not a positive
        number.
        """
        require(not config.quantise, "a tokenizer for latents needs tokenizer.quantise=false")
        require(
            math.isfinite(latent_std) and latent_std > 0,
            f"the standard deviation of the latents must be positive, got {latent_std}; the tokenizer's latents do "
            "not vary, so it has learnt nothing",
        )
        self.latent_std = latent_std
        super().__init__(config, params, piece=piece)

    def _from_latents(self, z: jax.Array) -> jax.Array:
        return z / self.latent_std

    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        # The encoder stays within +-1, so a value outside is an error of the generative model;
        # the nearest value inside is never further from the truth.
        return jnp.clip(tokens * self.latent_std, -1.0, 1.0)


def make_continuous(config: TokenizerConfig, params: Params, batches: Iterator[np.ndarray]) -> ContinuousTokenizer:
    """The tokenizer with its scale measured on uint8 images [B, H, W, 3] from `batches`."""
    unscaled = ContinuousTokenizer(config, params, latent_std=1.0)
    latents = np.concatenate([unscaled.encode(images) for images in islice(batches, SCALE_BATCHES)])
    return ContinuousTokenizer(config, params, float(np.std(latents, dtype=np.float64)))
