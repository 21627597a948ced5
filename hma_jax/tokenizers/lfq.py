"""The discrete tokenizer: convolutional autoencoder with lookup-free quantisation."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hma_jax.config import TokenizerConfig, require
from hma_jax.model.frames import factorise
from hma_jax.model.params import Params
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids


class LfqTokenizer(AutoencoderTokenizer):
    """Tokens are ids: int32 [B, S] below V^Q."""

    kind = "lfq"
    ignored = ("quantise", "latent_noise")

    def __init__(self, config: TokenizerConfig, params: Params, **placement: Any):
        """Raises ConfigError if `params` are not those that `config` declares."""
        require(config.quantise, "a tokenizer of ids needs tokenizer.quantise=true")
        super().__init__(config, params, **placement)

    def _from_latents(self, z: jax.Array) -> jax.Array:
        return latents_to_ids(z)

    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        return ids_to_codes(tokens, self.config.bits)


def code_usage(tokenizer: Tokenizer, images: np.ndarray) -> tuple[float, ...]:
    """Perplexity of each factor's code distribution over all positions of `images`; at most V."""
    digits = np.asarray(factorise(tokenizer.encode(images), tokenizer.factors, tokenizer.factor_vocab))
    usage = []
    for factor in range(tokenizer.factors):
        counts = np.bincount(digits[..., factor].ravel())
        p = counts[counts > 0] / counts.sum()
        usage.append(float(np.exp(-np.sum(p * np.log(p)))))
    return tuple(usage)
