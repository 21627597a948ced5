"""What all tokenizers state about their tokens; the tokenizer that is trained here, and its training."""

from __future__ import annotations

from dataclasses import dataclass

from hma_jax.config.base import check_fields, require, require_seed

ImageSize = int | tuple[int, int]
"""Pixels along the sides of an image: one number for a square, else (height, width)."""

ENTROPY_BITS = 12
"""The most bits of a factor for which entropies are computed: they need an array of all its codes for every token."""


class TokenGrid:
    """What follows from `image_size` and `token_size`: tokens on a grid, row by row."""

    image_size: ImageSize

    @property
    def token_size(self) -> int:
        """Pixels along one side of a token, which is square."""
        raise NotImplementedError

    @property
    def image_shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        size = self.image_size
        return (size, size) if isinstance(size, int) else size

    @property
    def grid_shape(self) -> tuple[int, int]:
        """(rows, columns) of tokens."""
        height, width = self.image_shape
        return height // self.token_size, width // self.token_size

    @property
    def grid(self) -> int:
        """Tokens along one side of a square image. Raises ConfigError for images that are not square."""
        rows, columns = self.grid_shape
        require(
            rows == columns,
            f"the grid of {rows} x {columns} tokens is not square, so it has no single side; use grid_shape",
        )
        return rows

    @property
    def tokens(self) -> int:
        """S: tokens per frame."""
        rows, columns = self.grid_shape
        return rows * columns

    def _check_size(self, name: str) -> None:
        height, width = self.image_shape
        require(
            min(height, width) >= 1 and height % self.token_size == 0 == width % self.token_size,
            f"{name}.image_size {self.image_size} is not a multiple of {self.token_size}, a token's side",
        )
        if height == width:
            # One way to write a square: equal settings have one identity.
            object.__setattr__(self, "image_size", height)


@dataclass(frozen=True)
class TokenizerConfig(TokenGrid):
    """The small convolutional tokenizer, with or without lookup-free quantisation.

    An image of `image_size` x `image_size` becomes (image_size / downsample)^2 tokens. Quantised
    (`tokenizers.lfq`), a token is an id of `bits` binary channels, split evenly into `factors`
    vocabulary factors. Otherwise (`tokenizers.continuous`) it is a vector of `bits` real channels; `factors`, the
    entropy and the commitment settings then have no effect.
    """

    image_size: int = 32  # side of an image in pixels
    downsample: int = 8  # side of a token in pixels
    quantise: bool = True  # true: tokens are ids; false: latents
    bits: int = 16  # bits per id; without quantisation, channels per latent
    factors: int = 2  # factors that an id is split into
    channels: int = 256  # channels inside encoder and decoder
    encoder_blocks: int = 1  # residual blocks of the encoder
    decoder_blocks: int = 2  # residual blocks of the decoder
    entropy_weight: float = 0.0  # weight of the entropy loss, which makes the tokenizer use all codes
    entropy_temperature: float = 1.0  # temperature of the soft code assignment in the entropy loss
    commitment_weight: float = 0.0  # weight of the commitment loss: the distance of values from their codes
    # Without quantisation: standard deviation of the noise that training adds to the latents, which lie in
    # -1..1. It makes the decoder tolerate the errors of a generative model: on the suite, 0.1 costs 0.6 dB without
    # errors and gains 1.7 dB where errors are 0.2 (of latents scaled to 1); 0.2 costs 1.3 dB and is better only for
    # errors of 0.3 or more.
    latent_noise: float = 0.1

    def __post_init__(self):
        check_fields(self)
        d = self.downsample
        require(d >= 2 and d & (d - 1) == 0, f"tokenizer.downsample must be a power of two, got {d}")
        require(
            self.image_size >= d and self.image_size % d == 0,
            f"tokenizer.image_size {self.image_size} is not a multiple of downsample {d}",
        )
        require(self.bits >= 1, f"tokenizer.bits must be at least 1, got {self.bits}")
        if self.quantise:
            self._check_factors()
        require(self.channels >= 1, "tokenizer.channels must be at least 1")
        counts, weights = ("encoder_blocks", "decoder_blocks"), ("entropy_weight", "commitment_weight")
        for name in (*counts, *weights, "latent_noise"):
            require(getattr(self, name) >= 0, f"tokenizer.{name} must not be negative")
        require(self.entropy_temperature > 0, "tokenizer.entropy_temperature must be positive")

    def _check_factors(self) -> None:
        require(
            self.factors >= 1 and self.bits % self.factors == 0,
            f"tokenizer.bits {self.bits} cannot be split into {self.factors} equal factors",
        )
        require(self.bits <= 24, f"tokenizer.bits must be at most 24, got {self.bits}")
        require(
            self.has_entropies or not self.entropy_weight,
            f"tokenizer.factors {self.factors}: a factor of {self.bits // self.factors} bits is too wide for the entropy "
            f"loss (at most {ENTROPY_BITS}); use more factors, or entropy_weight=0",
        )

    @property
    def has_entropies(self) -> bool:
        """Whether training computes the entropies of the codes, if only to record them."""
        return self.bits // self.factors <= ENTROPY_BITS

    @property
    def token_size(self) -> int:
        return self.downsample

    @property
    def token_channels(self) -> int:
        """C: values per token; 0 where tokens are ids."""
        return 0 if self.quantise else self.bits

    @property
    def factor_vocab(self) -> int:
        """V: entries per factor; 0 where tokens are latents."""
        return 2 ** (self.bits // self.factors) if self.quantise else 0

    @property
    def vocab_size(self) -> int:
        """V^Q; 0 where tokens are latents."""
        return 2**self.bits if self.quantise else 0


@dataclass(frozen=True)
class TokenizerTrainConfig:
    """How a tokenizer is trained. `batch` counts images per step."""

    steps: int = 2000  # number of optimiser steps
    batch: int = 64  # images per step
    learning_rate: float = 3e-3  # peak learning rate, after the warm-up; then a cosine schedule
    warmup_steps: int = 50  # steps in which the learning rate rises from 0
    final_fraction: float = 0.01  # learning rate at the end, as a fraction of the peak
    weight_decay: float = 1e-4  # AdamW's weight decay; applies to matrices and convolution kernels
    clip_norm: float = 1.0  # gradients with a larger norm are scaled down to it
    seed: int = 0  # random seed of initial values and order of frames

    def __post_init__(self):
        check_fields(self, infinite_allowed=("clip_norm",))
        require(self.steps >= 1, f"tokenizer training: steps must be at least 1, got {self.steps}")
        require(self.batch >= 1, f"tokenizer training: batch must be at least 1, got {self.batch}")
        require(
            self.learning_rate > 0,
            f"tokenizer training: learning_rate must be positive, got {self.learning_rate}",
        )
        require(self.warmup_steps >= 0, "tokenizer training: warmup_steps must not be negative")
        require(self.clip_norm > 0, "tokenizer training: clip_norm must be positive")
        require(
            self.weight_decay >= 0, f"tokenizer training: weight_decay must not be negative, got {self.weight_decay}"
        )
        require_seed(self.seed, "tokenizer training: seed")
        require(
            0 <= self.final_fraction <= 1,
            f"tokenizer training: final_fraction must lie in [0, 1], got {self.final_fraction}",
        )
