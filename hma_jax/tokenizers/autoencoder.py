"""What the trainable tokenizers share: the small network of `network`.

Subclasses decide what a token is: `lfq` makes ids, `continuous` latents. Training is in `train`, files are in `io`.
"""

from __future__ import annotations

import abc
from functools import lru_cache

import jax

from hma_jax.config import TokenizerConfig
from hma_jax.model.params import Declared, Params, declare
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.network import Autoencoder, from_pixels, to_pixels


@lru_cache(maxsize=16)
def declare_tokenizer(config: TokenizerConfig) -> Declared[Autoencoder]:
    """The network's parameters, without arrays."""
    return declare(lambda: Autoencoder(config))


class AutoencoderTokenizer(Tokenizer):
    """Encodes and decodes with `network.Autoencoder`; subclasses convert between its latents and tokens."""

    config_class = TokenizerConfig

    @classmethod
    def declare(cls, config: TokenizerConfig) -> Declared[Autoencoder]:
        return declare_tokenizer(config)

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        # Full float32 on accelerators too: their default precision would flip bits of latents near zero.
        with jax.default_matmul_precision("highest"):
            return self._from_latents(self._declared.merge(params).encoder(from_pixels(images)))

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        return to_pixels(self._declared.merge(params).decoder(self._to_latents(tokens)))

    @abc.abstractmethod
    def _from_latents(self, z: jax.Array) -> jax.Array:
        """Tokens of the encoder's output [B, S, bits] in -1..1."""

    @abc.abstractmethod
    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        """The decoder's input, float32 [B, S, bits], of tokens."""
