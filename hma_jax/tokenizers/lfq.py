"""The discrete tokenizer: convolutional autoencoder with lookup-free quantisation."""

from __future__ import annotations

import jax

from hma_jax.config import TokenizerConfig, require
from hma_jax.model.params import Params
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids


class LfqTokenizer(AutoencoderTokenizer):
    """Tokens are ids: int32 [B, S] below V^Q."""

    kind = "lfq"
    ignored = ("quantise", "latent_noise")

    def __init__(self, config: TokenizerConfig, params: Params, *, piece: int | None = None):
        """Raises ConfigError if `params` are not those that `config` declares."""
        require(config.quantise, "a tokenizer for ids needs tokenizer.quantise=true")
        super().__init__(config, params, piece=piece)

    def _from_latents(self, z: jax.Array) -> jax.Array:
        return latents_to_ids(z)

    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        return ids_to_codes(tokens, self.config.bits)
