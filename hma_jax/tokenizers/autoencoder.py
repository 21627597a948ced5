"""What the trainable tokenizers share: the network's weights, their identity, images in and out.

What a token is, is up to the kinds: `lfq` makes ids, `continuous` latents. Training is
`train`'s business, files are `io`'s.
"""

from __future__ import annotations

import abc
import hashlib
import json
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ConfigError, TokenizerConfig, require, to_dict
from hma_jax.evaluation.metrics import Stat, mean_and_sem, psnr
from hma_jax.params import Declared, Params, declare, path_name
from hma_jax.tokenizers.base import Tokenizer, in_pieces
from hma_jax.tokenizers.network import Autoencoder, normalise, to_pixels


def declare_tokenizer(config: TokenizerConfig) -> Declared:
    """The network's parameters, without arrays."""
    return declare(lambda: Autoencoder(config))


class AutoencoderTokenizer(abc.ABC):
    """A tokenizer with weights. Implements `base.Tokenizer` but for the meaning of a token."""

    kind: ClassVar[str]
    ignored: ClassVar[tuple[str, ...]]
    """Settings of the other kind: they are no part of the identity."""

    def __init__(self, config: TokenizerConfig, params: Params):
        """Raises ConfigError if `params` are not those that `config` declares."""
        declared = declare_tokenizer(config)
        expected = {name: spec.shape for name, spec in declared.leaves().items()}
        given = {path_name(p): tuple(x.shape) for p, x in jax.tree.leaves_with_path(params)}
        for name in sorted(expected.keys() | given.keys()):
            if expected.get(name) != given.get(name):
                raise ConfigError(
                    f"tokenizer weights do not fit their configuration: {name} should be "
                    f"{expected.get(name, 'absent')} but is {given.get(name, 'absent')}"
                )
        self.config = config
        self.params = params
        self._declared = declared
        self._encode = jax.jit(self.encode_fn)
        self._decode = jax.jit(lambda p, tokens: jnp.round(self.decode_fn(p, tokens)).astype(jnp.uint8))

    @property
    def image_size(self) -> int:
        return self.config.image_size

    @property
    def grid(self) -> int:
        return self.config.grid

    @property
    def tokens(self) -> int:
        return self.config.tokens

    @property
    def channels(self) -> int:
        return self.config.token_channels

    @property
    def vocab_size(self) -> int:
        return self.config.vocab_size

    @property
    def factors(self) -> int:
        return 0 if self.channels else self.config.factors

    @property
    def factor_vocab(self) -> int:
        return self.config.factor_vocab

    @cached_property
    def identity(self) -> str:
        settings = {k: v for k, v in to_dict(self.config).items() if k not in self.ignored}
        named = [self.kind, settings, *self._measured()]
        digest = hashlib.sha256(json.dumps(named, sort_keys=True).encode())
        for path, array in jax.tree.leaves_with_path(self.params):
            digest.update(path_name(path).encode())
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
        return digest.hexdigest()[:16]

    def _measured(self) -> tuple[float, ...]:
        """Numbers beside the weights that the tokens depend on."""
        return ()

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        """Pure: images [B, H, W, 3] in 0..255 -> tokens [B, S] or [B, S, C]."""
        return self._from_latents(self._declared.merge(params).encoder(normalise(images)))

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure: tokens [B, S] or [B, S, C] -> float32 [B, H, W, 3] in 0..255."""
        return to_pixels(self._declared.merge(params).decoder(self._to_latents(tokens)))

    def encode(self, images: np.ndarray) -> np.ndarray:
        """uint8 [B, H, W, 3] -> int32 [B, S] or float32 [B, S, C].

        Raises ConfigError for another shape or type.
        """
        images = np.asarray(images)
        shape = (self.image_size, self.image_size, 3)
        require(
            images.dtype == np.uint8 and images.ndim == 4 and images.shape[1:] == shape,
            f"the tokenizer encodes uint8 images [B, {', '.join(map(str, shape))}], "
            f"got {images.dtype} {list(images.shape)}",
        )
        return in_pieces(lambda piece: self._encode(self.params, piece), images)

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Tokens [B, S] or [B, S, C] -> uint8 [B, H, W, 3].

        Raises ConfigError for another shape or type, and for values that are no tokens.
        """
        tokens = self._checked(np.asarray(tokens))
        return in_pieces(lambda piece: self._decode(self.params, piece), tokens)

    @abc.abstractmethod
    def _from_latents(self, z: jax.Array) -> jax.Array:
        """Tokens of the encoder's output [B, S, bits] in -1..1."""

    @abc.abstractmethod
    def _to_latents(self, tokens: jax.Array) -> jax.Array:
        """The decoder's input, float32 [B, S, bits], of tokens."""

    @abc.abstractmethod
    def _checked(self, tokens: np.ndarray) -> np.ndarray:
        """`tokens` in the type that is decoded; ConfigError if they cannot be."""


def reconstruction_psnr(tokenizer: Tokenizer, images: np.ndarray) -> Stat:
    """PSNR in dB of images [n, H, W, 3] against what is left of them after encode and decode."""
    return mean_and_sem(psnr(images, tokenizer.decode(tokenizer.encode(images))))
