"""The trainable tokenizer: convolutional autoencoder with lookup-free quantisation.

Ties the network (`network`) and the quantiser (`quantizer`) into the `base.Tokenizer`
interface. Training is `train`'s business, files are `io`'s.
"""

from __future__ import annotations

import hashlib
import json
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ConfigError, TokenizerConfig, require, to_dict
from hma_jax.evaluation.metrics import Stat, mean_and_sem, psnr
from hma_jax.params import Declared, Params, declare, path_name
from hma_jax.tokenizers.base import Tokenizer, in_pieces
from hma_jax.tokenizers.network import Autoencoder, normalise, to_pixels
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids, split_factors

KIND = "lfq"


def declare_tokenizer(config: TokenizerConfig) -> Declared:
    """The network's parameters, without arrays."""
    return declare(lambda: Autoencoder(config))


class LfqTokenizer:
    """A tokenizer with weights. Implements `base.Tokenizer`."""

    kind = KIND

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
        self._decode = jax.jit(lambda p, ids: jnp.round(self.decode_fn(p, ids)).astype(jnp.uint8))

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
    def vocab_size(self) -> int:
        return self.config.vocab_size

    @property
    def factors(self) -> int:
        return self.config.factors

    @property
    def factor_vocab(self) -> int:
        return self.config.factor_vocab

    @cached_property
    def identity(self) -> str:
        digest = hashlib.sha256(json.dumps([self.kind, to_dict(self.config)], sort_keys=True).encode())
        for path, array in jax.tree.leaves_with_path(self.params):
            digest.update(path_name(path).encode())
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
        return digest.hexdigest()[:16]

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        """Pure: images [B, H, W, 3] in 0..255 -> int32 [B, S]."""
        return latents_to_ids(self._declared.merge(params).encoder(normalise(images)))

    def decode_fn(self, params: Params, ids: jax.Array) -> jax.Array:
        """Pure: ids [B, S] -> float32 [B, H, W, 3] in 0..255."""
        codes = ids_to_codes(ids, self.config.bits)
        return to_pixels(self._declared.merge(params).decoder(codes))

    def encode(self, images: np.ndarray) -> np.ndarray:
        """uint8 [B, H, W, 3] -> int32 [B, S]. Raises ConfigError for another shape or type."""
        images = np.asarray(images)
        shape = (self.image_size, self.image_size, 3)
        require(
            images.dtype == np.uint8 and images.ndim == 4 and images.shape[1:] == shape,
            f"the tokenizer encodes uint8 images [B, {', '.join(map(str, shape))}], "
            f"got {images.dtype} {list(images.shape)}",
        )
        return in_pieces(lambda piece: self._encode(self.params, piece), images)

    def decode(self, ids: np.ndarray) -> np.ndarray:
        """Ids [B, S] -> uint8 [B, H, W, 3]. Raises ConfigError for another shape or range."""
        ids = np.asarray(ids)
        require(
            ids.ndim == 2 and ids.shape[1] == self.tokens,
            f"the tokenizer decodes ids [B, {self.tokens}], got {list(ids.shape)}",
        )
        low, high = int(ids.min(initial=0)), int(ids.max(initial=0))
        require(
            low >= 0 and high < self.vocab_size,
            f"token ids must lie in [0, {self.vocab_size}), got {low} to {high}; "
            "is a mask id left, or were they made by another tokenizer?",
        )
        return in_pieces(lambda piece: self._decode(self.params, piece), ids.astype(np.int32))


def reconstruction_psnr(tokenizer: Tokenizer, images: np.ndarray) -> Stat:
    """PSNR in dB of images [n, H, W, 3] against what is left of them after encode and decode."""
    return mean_and_sem(psnr(images, tokenizer.decode(tokenizer.encode(images))))


def code_usage(tokenizer: Tokenizer, images: np.ndarray) -> tuple[float, ...]:
    """Perplexity of each factor's code distribution over all positions of `images`; at most V."""
    digits = np.asarray(split_factors(tokenizer.encode(images), tokenizer.factors, tokenizer.factor_vocab))
    usage = []
    for factor in range(tokenizer.factors):
        counts = np.bincount(digits[..., factor].ravel())
        p = counts[counts > 0] / counts.sum()
        usage.append(float(np.exp(-np.sum(p * np.log(p)))))
    return tuple(usage)
