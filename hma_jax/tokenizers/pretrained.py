"""The tokenizers that others trained, behind the interface of our own.

`Magvit2Tokenizer` makes the ids, `SvdVaeTokenizer` the latents that released HMA models were trained
on. Reading their weights from the files they are published in is `convert.pretrained`'s business.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange

from hma_jax.config import Magvit2Config, SvdVaeConfig, TokenGrid, require
from hma_jax.model.frames import patchify, unpatchify
from hma_jax.model.params import Declared, Params, declare
from hma_jax.tokenizers.base import PIECE, in_pieces
from hma_jax.tokenizers.magvit2 import Magvit2
from hma_jax.tokenizers.network import from_pixels, to_pixels
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids
from hma_jax.tokenizers.shared import BaseTokenizer
from hma_jax.tokenizers.svd_vae import SvdVae

PIXELS = 2**18
"""Pixels that go through a large network at once: four images of 256 x 256."""

LATENT_LIMIT = 25.0
"""What unscaled latents are clipped to before they are decoded, as in the release."""


def _piece(config: TokenGrid) -> int:
    return max(1, min(PIECE, PIXELS // math.prod(config.image_shape)))


class Magvit2Tokenizer(BaseTokenizer):
    """Tokens are ids: int32 [B, S] below 2^bits. Bit k of an id is the sign of channel k."""

    kind = "magvit2"
    config_class = Magvit2Config

    @classmethod
    def declare(cls, config: Magvit2Config) -> Declared[Magvit2]:
        return declare(lambda: Magvit2(config))

    @classmethod
    def default_piece(cls, config: Magvit2Config) -> int:
        return _piece(config)

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        z = self._declared.merge(params).encoder(from_pixels(images))
        return rearrange(latents_to_ids(z), "b h w -> b (h w)")

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        grid = rearrange(tokens, "b (h w) -> b h w", h=self.config.grid_shape[0])
        return to_pixels(self._declared.merge(params).decoder(ids_to_codes(grid, self.config.bits)))


class SvdVaeTokenizer(BaseTokenizer):
    """Tokens are patches of latent cells, float32 [B, S, C]: the posterior mean times `scale`."""

    kind = "svd-vae"
    config_class = SvdVaeConfig

    @classmethod
    def declare(cls, config: SvdVaeConfig) -> Declared[SvdVae]:
        return declare(lambda: SvdVae(config))

    @classmethod
    def default_piece(cls, config: SvdVaeConfig) -> int:
        return _piece(config)

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        mean, _ = self._declared.merge(params).moments(from_pixels(images))
        return self.tokens_of(mean)

    def decode_fn(self, params: Params, tokens: jax.Array, frames: int = 1) -> jax.Array:
        """Pure: latents [B, S, C] -> float32 [B, H, W, 3] in 0..255.

        Every `frames` consecutive entries of the batch are a clip, whose frames the decoder mixes.
        """
        cells = jnp.clip(self.cells(tokens), -LATENT_LIMIT, LATENT_LIMIT)
        return to_pixels(self._declared.merge(params).decode(cells, frames))

    def decode_clips(self, clips: np.ndarray) -> np.ndarray:
        """Latents [B, T, S, C] -> uint8 [B, T, H, W, 3], the frames of a clip decoded together.

        Raises ConfigError for another shape or type.
        """
        clips = np.asarray(clips)
        require(clips.ndim == 4, f"clips of latents are [B, T, S, C], got {list(clips.shape)}")
        checked = self._checked(clips.reshape(-1, *clips.shape[2:])).reshape(clips.shape)
        size = max(1, self.piece // clips.shape[1]) * self._mesh.size
        return in_pieces(lambda piece: self._decode_clips(self._device_params, piece), checked, size)

    @cached_property
    def _decode_clips(self) -> Callable:
        def decode(params: Params, clips: jax.Array) -> jax.Array:
            batch, frames, *token = clips.shape
            images = self.decode_fn(params, clips.reshape(-1, *token), frames)
            return jnp.round(images).astype(jnp.uint8).reshape(batch, frames, *images.shape[1:])

        return self._jit_over_devices(decode)

    def tokens_of(self, cells: jax.Array) -> jax.Array:
        """Unscaled latents [..., h, w, c], which the release stores channels first -> tokens [..., S, C]."""
        return patchify(cells * self.config.scale, self.config.patch)

    def cells(self, tokens: jax.Array) -> jax.Array:
        """The inverse of `tokens_of`."""
        return unpatchify(tokens, self.config.patch, self.config.grid_shape[1]) / self.config.scale
