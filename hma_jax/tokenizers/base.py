"""The interface of all tokenizers, whether one fits a model, and how images pass through it in batches of one size.

Code outside this package depends on `Tokenizer` alone: any model that turns frames into ids or
latent vectors and back can stand behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np

from hma_jax.config import ModelConfig, require
from hma_jax.model.params import Params

PIECE = 64
"""Images per call of a jitted encoder or decoder; smaller batches are padded to it."""

PIXELS = 2**18
"""Pixels that go through a large network at once: four images of 256 x 256."""


class Tokenizer(Protocol):
    """Images to S tokens each, and back.

    A token is an id, int32, or a vector of C latent channels, float32 of about unit standard
    deviation. Tokens run over a grid row by row, a square one where images are square. An id is
    sum_q digit_q V^q: factor 0 in the low digits. Both directions are deterministic, and an image's
    result does not depend on the others of its batch: tokens made in one job equal those made in another. Another
    kind of device sums products in another order, which may turn a bit whose latent is all but 0.
    """

    @property
    def image_size(self) -> int:
        """Pixels along one side. ConfigError if images are not square."""
        ...

    @property
    def image_shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        ...

    @property
    def grid(self) -> int:
        """Tokens along one side of the image. ConfigError if images are not square."""
        ...

    @property
    def tokens(self) -> int:
        """S: tokens per frame."""
        ...

    @property
    def channels(self) -> int:
        """C; 0: tokens are ids."""
        ...

    @property
    def vocab_size(self) -> int:
        """V^Q; 0: tokens are latents."""
        ...

    @property
    def factors(self) -> int:
        """Q; 0: tokens are latents."""
        ...

    @property
    def factor_vocab(self) -> int:
        """V; 0: tokens are latents."""
        ...

    @property
    def identity(self) -> str:
        """Hash of configuration and weights: equal means the same tokens for the same images."""
        ...

    @property
    def params(self) -> Params: ...

    @property
    def piece(self) -> int:
        """Images that a device takes at a time."""
        ...

    @property
    def at_once(self) -> int:
        """Images of one call: `piece` on every device. A smaller batch is padded to it."""
        ...

    def encode(self, images: np.ndarray) -> np.ndarray:
        """uint8 [B, height, width, 3] -> int32 [B, S] or float32 [B, S, C]."""
        ...

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """What `encode` makes -> uint8 [B, height, width, 3]."""
        ...

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure, for use inside a jit: what `encode` makes -> float32 [B, ...] in 0..255."""
        ...

    def decode_uint8_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure, for use inside a jit: `decode_fn` rounded as `decode` does it."""
        ...


def token_mismatch(model: ModelConfig, tokenizer: Tokenizer) -> str:
    """How the tokens that a model takes differ from those that a tokenizer makes; '' if they do not."""
    if model.diffusion:
        takes = (model.tokens, 0, 0, model.diffusion.token_channels)
    else:
        takes = (model.tokens, model.factors, model.factor_vocab, 0)
    makes = (tokenizer.tokens, tokenizer.factors, tokenizer.factor_vocab, tokenizer.channels)
    words = "{0} tokens per frame of {1} factors with {2} entries and {3} latent channels"
    if takes == makes:
        return ""
    return f"the model needs {words.format(*takes)}, but the tokenizer makes {words.format(*makes)}"


def fitting_piece(image_shape: tuple[int, int]) -> int:
    """Images that a large network takes at a time: at most PIECE of them, and PIXELS."""
    return max(1, min(PIECE, PIXELS // math.prod(image_shape)))


def in_pieces(function: Callable[[np.ndarray], Any], rows: np.ndarray, size: int = PIECE) -> np.ndarray:
    """Applies `function` to consecutive pieces of exactly `size` rows; the last one is padded.

    One static shape means one compilation, and rounding that does not depend on the number of rows: a latent near zero
    must not change its sign with the batch it came in.
    """
    require(len(rows) > 0, "an empty batch cannot be encoded or decoded")
    results = []
    for start in range(0, len(rows), size):
        piece = rows[start : start + size]
        missing = size - len(piece)
        if missing:
            piece = np.concatenate([piece, np.zeros((missing, *piece.shape[1:]), piece.dtype)])
        results.append(function(piece))  # dispatched asynchronously: the device works while the next is sliced
    return np.concatenate([np.asarray(r) for r in results])[: len(rows)]
