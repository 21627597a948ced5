"""Configurations of the tokenizers that are not trained here: two pretrained ones, pixels, and the user's own.

The trainable one is `hma_jax.config.TokenizerConfig`. Each states the size of an image and what its tokens are; `kind`
tells them apart where a configuration may be any of them. Nothing here imports JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hma_jax.config.base import check_fields, require
from hma_jax.config.execution import Dtype
from hma_jax.config.tokenizer import ImageSize, TokenGrid, TokenizerConfig


class Latents(TokenGrid):
    """Tokens are `patch` x `patch` cells of `cell_channels` values each, flattened row by row."""

    patch: int
    factors = 0
    factor_vocab = 0
    vocab_size = 0

    @property
    def cell_channels(self) -> int:
        raise NotImplementedError

    @property
    def token_channels(self) -> int:
        """C: values per token."""
        return self.patch**2 * self.cell_channels


@dataclass(frozen=True)
class Magvit2Config(TokenGrid):
    """The MAGVIT2 image tokenizer of 1X, and of Open-MAGVIT2 without adaptive normalisation. The defaults are those of
    the tokenizer that 1X published (2^18 codes).

    Reference appendix A. Every level but the last halves the image. Tokens are ids of `bits` binary channels, split
    evenly into `factors`.
    """

    kind: Literal["magvit2"] = "magvit2"
    image_size: ImageSize = 256
    channels: int = 128  # of the first level
    multipliers: tuple[int, ...] = (1, 1, 2, 2, 4)  # of `channels`, level by level
    res_blocks: int = 2  # per level, and in the middle
    bits: int = 18
    groups: int = 32  # of the normalisations
    factors: int = 2
    # DIFFERS: the release encodes in bfloat16, where latents near zero change their bit.
    compute_dtype: Dtype = "float32"

    def __post_init__(self):
        check_fields(self)
        require(len(self.multipliers) >= 1, "magvit2.multipliers is empty; give one per level")
        _check_levels("magvit2", [self.channels * m for m in self.multipliers], self.groups)
        require(self.channels % self.groups == 0, f"magvit2.channels {self.channels} do not fit its groups")
        require(self.res_blocks >= 1, f"magvit2.res_blocks must be at least 1, got {self.res_blocks}")
        require(
            self.factors >= 1 and self.bits >= 1 and self.bits % self.factors == 0,
            f"magvit2.bits {self.bits} cannot be split into {self.factors} equal factors",
        )
        require(self.bits <= 24, f"magvit2.bits must be at most 24, got {self.bits}")
        self._check_size("magvit2")

    @property
    def token_size(self) -> int:
        return 2 ** (len(self.multipliers) - 1)

    @property
    def token_channels(self) -> int:
        return 0

    @property
    def factor_vocab(self) -> int:
        """V: entries per factor."""
        return 2 ** (self.bits // self.factors)

    @property
    def vocab_size(self) -> int:
        """V^Q."""
        return 2**self.bits


@dataclass(frozen=True)
class SvdVaeConfig(Latents):
    """The VAE of Stable Video Diffusion (AutoencoderKLTemporalDecoder); the defaults are those of the published model.

    An image of 256 pixels becomes 32 x 32 cells of 4 channels, and as released 2 x 2 cells make one
    token. Tokens are the posterior mean times `scale`, as released models see them, with a standard deviation of about
    1. (The release stores the mean itself and multiplies when it loads.)
    """

    kind: Literal["svd-vae"] = "svd-vae"
    image_size: ImageSize = 256
    channels: tuple[int, ...] = (128, 256, 512, 512)  # level by level; all but the last halve the image
    layers: int = 2  # residual blocks per level; the decoder has one more
    latent_channels: int = 4
    groups: int = 32
    scale: float = 0.18215
    patch: int = 2  # cells along one side of a token
    compute_dtype: Dtype = "float32"

    def __post_init__(self):
        check_fields(self)
        require(len(self.channels) >= 1, "svd-vae.channels is empty; give one number per level")
        _check_levels("svd-vae", self.channels, self.groups)
        for name in ("layers", "latent_channels", "patch"):
            require(getattr(self, name) >= 1, f"svd-vae.{name} must be at least 1, got {getattr(self, name)}")
        require(self.scale > 0, f"svd-vae.scale must be positive, got {self.scale}")
        self._check_size("svd-vae")

    @property
    def cell_channels(self) -> int:
        return self.latent_channels

    @property
    def token_size(self) -> int:
        return 2 ** (len(self.channels) - 1) * self.patch


@dataclass(frozen=True)
class PixelsConfig(Latents):
    """No network: a token is a patch of pixels, in -1..1 divided by `std`."""

    kind: Literal["pixels"] = "pixels"
    image_size: ImageSize = 64
    patch: int = 8
    std: float = 0.5  # of pixels in -1..1, about that of natural images

    def __post_init__(self):
        check_fields(self)
        require(self.patch >= 1, f"pixels.patch must be at least 1, got {self.patch}")
        require(self.std > 0, f"pixels.std must be positive, got {self.std}")
        self._check_size("pixels")

    @property
    def cell_channels(self) -> int:
        return 3

    @property
    def token_size(self) -> int:
        return self.patch


@dataclass(frozen=True)
class PythonConfig:
    """What the user's own Python code (`tokenizers.python`) says of its tokens: ids below `vocab_size`, or latents."""

    kind: Literal["python"] = "python"
    image_size: int = 256
    grid: int = 16  # tokens along one side of the image
    vocab_size: int = 0  # V^Q; 0: tokens are latents
    factors: int = 1  # Q: digits that an id is split into; without meaning for latents
    channels: int = 0  # C: values per token; 0: tokens are ids

    def __post_init__(self):
        check_fields(self)
        for name in ("image_size", "grid", "factors"):
            require(getattr(self, name) >= 1, f"python.{name} must be at least 1, got {getattr(self, name)}")
        require(
            (self.vocab_size >= 2 and self.channels == 0) or (self.vocab_size == 0 and self.channels >= 1),
            "a tokenizer makes ids of a vocab_size of at least 2, or latents of at least one of channels; got "
            f"vocab_size {self.vocab_size} and channels {self.channels}",
        )
        require(
            self.factor_vocab**self.factors == self.vocab_size or self.channels > 0,
            f"python.vocab_size {self.vocab_size} is not a whole number to the power of factors {self.factors}, so ids "
            "cannot be split evenly; take one factor, or a larger vocab_size of which some ids stay unused",
        )

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.image_size, self.image_size

    @property
    def grid_shape(self) -> tuple[int, int]:
        return self.grid, self.grid

    @property
    def tokens(self) -> int:
        return self.grid**2

    @property
    def token_channels(self) -> int:
        return self.channels

    @property
    def factor_vocab(self) -> int:
        """V: entries per factor; 0 where tokens are latents."""
        return round(self.vocab_size ** (1 / self.factors)) if self.vocab_size else 0


AnyTokenizerConfig = TokenizerConfig | Magvit2Config | SvdVaeConfig | PixelsConfig | PythonConfig


def _check_levels(name: str, widths: list[int] | tuple[int, ...], groups: int) -> None:
    """Raises ConfigError unless the channels of every level split into `groups` normalisation groups."""
    require(groups >= 1, f"{name}.groups must be at least 1, got {groups}")
    for width in widths:
        require(
            width >= 1 and width % groups == 0,
            f"{name}: a level of {width} channels cannot be split into {groups} groups",
        )
