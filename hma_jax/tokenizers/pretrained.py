"""Tokenizers that others trained, with the same interface as our own.

`Magvit2Tokenizer` makes the ids, and `SvdVaeTokenizer` the latents, on which released HMA models were trained.
`convert.pretrained` reads their weights from the published files.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from einops import rearrange

from hma_jax.config import Magvit2Config, SvdVaeConfig
from hma_jax.model.frames import patchify, unpatchify
from hma_jax.model.params import Declared, Params, declare
from hma_jax.tokenizers.base import Tokenizer, fitting_piece
from hma_jax.tokenizers.magvit2 import Magvit2
from hma_jax.tokenizers.network import from_pixels, to_pixels
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids
from hma_jax.tokenizers.svd_vae import SvdVae

LATENT_LIMIT = 25.0
"""The limit to which unscaled latents are clipped before they are decoded, as in the release."""


class Magvit2Tokenizer(Tokenizer):
    """Tokens are ids: int32 [B, S] below 2^bits. Bit k of an id is the sign of channel k."""

    kind = "magvit2"
    config_class = Magvit2Config

    @classmethod
    def declare(cls, config: Magvit2Config) -> Declared[Magvit2]:
        return declare(lambda: Magvit2(config))

    @classmethod
    def default_piece(cls, config: Magvit2Config) -> int:
        return fitting_piece(config.image_shape)

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        z = self._declared.merge(params).encoder(from_pixels(images))
        return rearrange(latents_to_ids(z), "b h w -> b (h w)")

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        grid = rearrange(tokens, "b (h w) -> b h w", h=self.config.grid_shape[0])
        return to_pixels(self._declared.merge(params).decoder(ids_to_codes(grid, self.config.bits)))


class SvdVaeTokenizer(Tokenizer):
    """Tokens are patches of latent cells, float32 [B, S, C]: the posterior mean times `scale`."""

    kind = "svd-vae"
    config_class = SvdVaeConfig

    @classmethod
    def declare(cls, config: SvdVaeConfig) -> Declared[SvdVae]:
        return declare(lambda: SvdVae(config))

    @classmethod
    def default_piece(cls, config: SvdVaeConfig) -> int:
        return fitting_piece(config.image_shape)

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        mean, _ = self._declared.merge(params).moments(from_pixels(images))
        return self.tokens_of(mean)

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        cells = jnp.clip(self.cells(tokens), -LATENT_LIMIT, LATENT_LIMIT)
        return to_pixels(self._declared.merge(params).decode(cells))

    def tokens_of(self, cells: jax.Array) -> jax.Array:
        """Unscaled latents [..., h, w, c], which the release stores channels first -> tokens [..., S, C]."""
        return patchify(cells * self.config.scale, self.config.patch)

    def cells(self, tokens: jax.Array) -> jax.Array:
        """The inverse of `tokens_of`."""
        return unpatchify(tokens, self.config.patch, self.config.grid_shape[1]) / self.config.scale
