"""No tokenizer at all: tokens are the pixels themselves, patch by patch.

Store, model and decoding are the same as for latents. Nothing is lost: decoding gives the original pixels, even from
float16, in which the token store keeps latents.
"""

from __future__ import annotations

import jax
from flax import nnx

from hma_jax.config import PixelsConfig
from hma_jax.model.frames import patchify, unpatchify
from hma_jax.model.params import Declared, Params, declare
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.network import from_pixels, to_pixels


class PixelTokenizer(Tokenizer):
    """Tokens are float32 [B, S, 3 patch^2]: a patch is flattened row by row, with the channels of each pixel
    together."""

    kind = "pixels"
    config_class = PixelsConfig

    def __init__(self, config: PixelsConfig, params: Params | None = None, *, piece: int | None = None):
        super().__init__(config, params or {}, piece=piece)

    @classmethod
    def declare(cls, config: PixelsConfig) -> Declared:
        del config
        return declare(nnx.Module)  # no parameters

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        return patchify(from_pixels(images) / self.config.std, self.config.patch)

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        return to_pixels(unpatchify(tokens, self.config.patch, self.config.grid_shape[1]) * self.config.std)
