"""The interface of tokenizers, and what all of them share: checked weights, identity, batches of one size on each
device.

Subclasses decide what a token is, and encode and decode.
"""

from __future__ import annotations

import abc
import hashlib
import json
import math
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from hma_jax.config import MeshConfig, ModelConfig, require
from hma_jax.config.json import identity_of
from hma_jax.model.params import Declared, Params, path_name, require_params
from hma_jax.runtime.mesh import make_mesh
from hma_jax.runtime.sharding import BATCH, replicated

PIECE = 64
"""Images per call of a jitted encoder or decoder; smaller batches are padded to it."""

LARGEST_LATENT = float(np.finfo(np.float16).max)
"""The largest latent: token stores keep latents in half precision, where a larger one would be infinite."""

PIXELS = 2**18
"""The most pixels that go through a large network at once: four images of 256 x 256."""


class Tokenizer(abc.ABC):
    """Images to S tokens each, and back.

    A token is an id, int32, or a vector of C latent channels, float32 of about unit standard deviation. Tokens run over
    a grid row by row, a square one where images are square. An id is sum_q digit_q V^q: factor 0 in the low digits.
    Both directions are deterministic, and the result for an image does not depend on the other images of its batch:
    tokens made in one job equal those made in another. A different kind of device sums products in a different order,
    which may flip a bit whose latent is almost 0.

    All devices of this process share every batch. On each of them `piece` images at a time go through the network, so
    that tokens do not depend on the number of devices.
    """

    kind: ClassVar[str]
    config_class: ClassVar[type]
    ignored: ClassVar[tuple[str, ...]] = ()
    """Settings that have no effect on this kind, and are left out of its identity."""
    measured: ClassVar[tuple[str, ...]] = ()
    """Names of numbers, besides the weights, on which the tokens depend; they are attributes and constructor
    arguments."""

    def __init__(self, config: Any, params: Params, *, piece: int | None = None):
        """Raises ConfigError if `params` are not those that `config` declares, or for a `piece` without an image."""
        self._declared = self.declare(config)
        self._set_up(config, params, self.default_piece(config) if piece is None else piece, jax.local_devices())
        require_params(self._declared, params, "tokenizer weights do not fit their configuration")

    def _set_up(self, config: Any, params: Params, piece: int, devices: list[jax.Device]) -> None:
        require(piece >= 1, f"a tokenizer must encode at least 1 image at a time, got {piece}")
        self.config, self.params, self.piece = config, params, piece
        self._mesh = make_mesh(MeshConfig(), devices)
        self._encode = self._jit_over_devices(self.encode_fn)
        self._decode = self._jit_over_devices(self.decode_uint8_fn)

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickling; after unpickling, a tokenizer uses the devices of the new process."""
        options = {name: getattr(self, name) for name in self.measured} | {"piece": self.piece}
        return partial(type(self), **options), (self.config, self.params)

    @classmethod
    @abc.abstractmethod
    def declare(cls, config: Any) -> Declared:
        """The network's parameters, without arrays."""

    @classmethod
    def default_piece(cls, config: Any) -> int:
        del config
        return PIECE

    # --- Facts -------------------------------------------------------------------------------

    @property
    def image_size(self) -> int:
        """Pixels along one side. Raises ConfigError if images are not square."""
        height, width = self.image_shape
        require(
            height == width,
            f"this tokenizer is for images of {height} x {width} pixels, but square images are needed; import it "
            "again with a single image size",
        )
        return height

    @property
    def image_shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.config.image_shape

    @property
    def grid(self) -> int:
        """Tokens along one side of the image. Raises ConfigError if images are not square."""
        return self.config.grid

    @property
    def tokens(self) -> int:
        """S: tokens per frame."""
        return self.config.tokens

    @property
    def channels(self) -> int:
        """C; 0: tokens are ids."""
        return self.config.token_channels

    @property
    def vocab_size(self) -> int:
        """V^Q; 0: tokens are latents."""
        return self.config.vocab_size

    @property
    def factors(self) -> int:
        """Q; 0: tokens are latents."""
        return 0 if self.channels else self.config.factors

    @property
    def factor_vocab(self) -> int:
        """V; 0: tokens are latents."""
        return self.config.factor_vocab

    @cached_property
    def identity(self) -> str:
        """Hash of configuration and weights: equal means the same tokens for the same images."""
        settings = {k: v for k, v in identity_of(self.config).items() if k not in self.ignored}
        named = [self.kind, settings, *(getattr(self, name) for name in self.measured)]
        digest = hashlib.sha256(json.dumps(named, sort_keys=True).encode())
        for path, array in jax.tree.leaves_with_path(self.params):
            digest.update(path_name(path).encode())
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
        return digest.hexdigest()[:16]

    # --- Images in and out -------------------------------------------------------------------

    @abc.abstractmethod
    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        """Pure: images [B, H, W, 3] in 0..255 -> tokens, int32 [B, S] or float32 [B, S, C]."""

    @abc.abstractmethod
    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure: tokens [B, S] or [B, S, C] -> float32 [B, H, W, 3] in 0..255."""

    def encode(self, images: np.ndarray) -> np.ndarray:
        """uint8 [B, H, W, 3] -> int32 [B, S] or float32 [B, S, C].

        Raises ConfigError for another shape or type.
        """
        images = np.asarray(images)
        require_images(images, self.image_shape, "the tokenizer encodes")
        return in_pieces(lambda piece: self._encode(self._device_params, piece), images, self.at_once)

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Tokens [B, S] or [B, S, C] -> uint8 [B, H, W, 3].

        Raises ConfigError for another shape or type, and for values that are not tokens.
        """
        tokens = self._checked(np.asarray(tokens))
        return in_pieces(lambda piece: self._decode(self._device_params, piece), tokens, self.at_once)

    def reconstruct(self, images: np.ndarray) -> np.ndarray:
        """uint8 [B, H, W, 3], encoded and decoded. Raises ConfigError as `encode` and `decode` do."""
        return np.asarray(self.decode(self.encode(images)))

    def require_tokens(self, tokens: np.ndarray, what: str, advice: str) -> None:
        """Raises ConfigError, which begins with `what` made them and ends with `advice`, for values that are not
        tokens. Compiled programs do not check: their results are checked when they reach the host."""
        wanted = f"finite numbers within ±{LARGEST_LATENT:,.0f}" if self.channels else f"in [0, {self.vocab_size})"
        require(
            self._are_tokens(tokens),
            f"{what} gives values from {tokens.min()} to {tokens.max()}; tokens must be {wanted}{advice}",
        )

    def _are_tokens(self, values: np.ndarray) -> bool:
        if self.channels:
            return bool((np.abs(values) <= LARGEST_LATENT).all())  # false for NaN
        return bool(0 <= values.min(initial=0) and values.max(initial=0) < self.vocab_size)

    def decode_uint8_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure: `decode` without its checks of the tokens."""
        # DIFFERS: the release truncates, which darkens every image by half a grey level.
        return jnp.round(self.decode_fn(params, tokens)).astype(jnp.uint8)

    def _checked(self, tokens: np.ndarray) -> np.ndarray:
        """`tokens` in the type that is decoded. Raises ConfigError if they cannot be decoded."""
        if self.channels:
            return self._checked_latents(tokens)
        require(
            tokens.dtype.kind in "iu" and tokens.ndim == 2 and tokens.shape[1] == self.tokens,
            f"the tokenizer decodes ids, integers [B, {self.tokens}], got {tokens.dtype} {list(tokens.shape)}",
        )
        require(
            self._are_tokens(tokens),
            f"token ids must lie in [0, {self.vocab_size}), got {tokens.min(initial=0)} to {tokens.max(initial=0)}; do "
            "they contain a mask id, or were they made by another tokenizer?",
        )
        return tokens.astype(np.int32)

    def _checked_latents(self, tokens: np.ndarray) -> np.ndarray:
        shape = (self.tokens, self.channels)
        require(
            tokens.dtype.kind == "f" and tokens.ndim == 3 and tokens.shape[1:] == shape,
            f"the tokenizer decodes latents, float [B, {self.tokens}, {self.channels}], "
            f"got {tokens.dtype} {list(tokens.shape)}",
        )
        tokens = tokens.astype(np.float32)
        require(bool(np.isfinite(tokens).all()), "latents are not finite; did the model diverge?")
        return tokens

    # --- Devices -----------------------------------------------------------------------------

    @property
    def at_once(self) -> int:
        """Images per call: `piece` on every device. A smaller batch is padded to this number."""
        return self.piece * self._mesh.size

    def _jit_over_devices(self, function: Callable[[Params, jax.Array], jax.Array]) -> Callable:
        """`function`, jitted; every device applies it to its own rows of the batch."""
        if self._mesh.size == 1:
            return jax.jit(function)
        whole, rows = PartitionSpec(), PartitionSpec(BATCH)
        # One program per device, with the shape that it has on a single device: so rounding is the same on any number.
        return jax.jit(jax.shard_map(function, mesh=self._mesh, in_specs=(whole, rows), out_specs=rows))

    @cached_property
    def _device_params(self) -> Params:
        """The parameters, on every device."""
        if self._mesh.size == 1:
            return self.params
        return jax.device_put(self.params, replicated(self._mesh))


def require_images(images: np.ndarray, shape: tuple[int, int], what: str) -> None:
    """Raises ConfigError, which begins with `what`, for anything but uint8 images of `shape` (height, width)."""
    height, width = shape
    require(
        images.dtype == np.uint8 and images.ndim == 4 and images.shape[1:] == (height, width, 3),
        f"{what} uint8 images [B, {height}, {width}, 3], got {images.dtype} {list(images.shape)}",
    )


def token_mismatch(model: ModelConfig, tokenizer: Tokenizer) -> str:
    """A message about how the tokens that a model takes differ from those that a tokenizer makes; '' if they do not."""
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
    """The number of images that a large network takes at a time: at most PIECE images, with at most PIXELS pixels."""
    return max(1, min(PIECE, PIXELS // math.prod(image_shape)))


def in_pieces(function: Callable[[np.ndarray], Any], rows: np.ndarray, size: int) -> np.ndarray:
    """Applies `function` to consecutive pieces of exactly `size` rows; the last one is padded with copies of a row.

    One static shape means one compilation, and rounding that does not depend on the number of rows: the sign of a
    latent near zero must not depend on its batch.
    """
    require(len(rows) > 0, "an empty batch cannot be encoded or decoded")
    results = []
    for start in range(0, len(rows), size):
        piece = rows[start : start + size]
        missing = size - len(piece)
        if missing:
            # Not with zeros, for which a network that normalises may give NaN.
            piece = np.concatenate([piece, np.repeat(piece[-1:], missing, axis=0)])
        results.append(function(piece))  # dispatched asynchronously: the device works while the next is sliced
    return np.concatenate([np.asarray(r) for r in results])[: len(rows)]
