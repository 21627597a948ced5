"""The discrete tokenizer: convolutional autoencoder with lookup-free quantisation."""

from __future__ import annotations

import jax
import numpy as np

from hma_jax.config import TokenizerConfig, require
from hma_jax.params import Params
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids, split_factors


class LfqTokenizer(AutoencoderTokenizer):
    """Tokens are ids: int32 [B, S] below V^Q."""

    kind = "lfq"
    ignored = ("quantise", "latent_noise")

    def __init__(self, config: TokenizerConfig, params: Params):
        """Raises ConfigError if `params` are not those that `config` declares."""
        require(config.quantise, "a tokenizer of ids needs tokenizer.quantise=true")
        super().__init__(config, params)

    def _from_latents(self, z: jax.Array) -> jax.Array:
        return latents_to_ids(z)

    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        return ids_to_codes(tokens, self.config.bits)

    def _checked(self, tokens: np.ndarray) -> np.ndarray:
        require(
            tokens.ndim == 2 and tokens.shape[1] == self.tokens,
            f"the tokenizer decodes ids [B, {self.tokens}], got {list(tokens.shape)}",
        )
        low, high = int(tokens.min(initial=0)), int(tokens.max(initial=0))
        require(
            low >= 0 and high < self.vocab_size,
            f"token ids must lie in [0, {self.vocab_size}), got {low} to {high}; "
            "is a mask id left, or were they made by another tokenizer?",
        )
        return tokens.astype(np.int32)


def code_usage(tokenizer: Tokenizer, images: np.ndarray) -> tuple[float, ...]:
    """Perplexity of each factor's code distribution over all positions of `images`; at most V."""
    digits = np.asarray(split_factors(tokenizer.encode(images), tokenizer.factors, tokenizer.factor_vocab))
    usage = []
    for factor in range(tokenizer.factors):
        counts = np.bincount(digits[..., factor].ravel())
        p = counts[counts > 0] / counts.sum()
        usage.append(float(np.exp(-np.sum(p * np.log(p)))))
    return tuple(usage)
