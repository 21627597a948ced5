"""What the transformer is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from hma_jax.config.base import check_fields, require


@dataclass(frozen=True)
class MupConfig:
    """Width transfer (paper section 3.5; practice in Tensor Programs V).

    `base_width` is where the multipliers are 1. Learning rate and initial variance of hidden
    matrices scale with base_width / D, the read-out's input with base_width / D, attention
    logits with `attention_scale` / head width. `without` takes single ingredients away, to show
    that each is needed.
    """

    enabled: bool = True  # whether anything scales with the width
    base_width: int = 256  # where the multipliers are 1
    attention_scale: float = 8.0  # attention logits scale with this over the width of a head
    without: tuple[Literal["init", "learning_rate", "readout", "attention"], ...] = ()  # ingredients taken away

    def __post_init__(self):
        check_fields(self)
        require(self.base_width >= 1, f"mup.base_width must be at least 1, got {self.base_width}")
        require(self.attention_scale > 0, f"mup.attention_scale must be positive, got {self.attention_scale}")


@dataclass(frozen=True)
class DiffusionConfig:
    """Diffusion over continuous vectors conditioned on the trunk (reference sections 2.4 and 2.5).

    `channels` and `patch` describe what is denoised for frames: a token is a patch of
    `patch` x `patch` latent cells of `channels` values, flattened to C = patch^2 x channels.
    """

    channels: int = 4  # values of a latent cell
    patch: int = 2  # latent cells along a side of a token
    width: int = 1024  # of the denoising network
    depth: int = 4  # its residual blocks
    steps: int = 1000  # of the noising process
    clip: float = 10.0  # predicted clean values are kept in +-clip while sampling
    repeats: int = 1  # noised copies of each token per training step
    # In training the squared error of the noise counts, as released, the same at every step (0), or is weighed by noise
    # over signal up to this, which makes it the squared error of the clean vector: mostly of what noise hides.
    weight_cap: float = 0.0
    # In training steps are drawn evenly, as released (1), or shifted towards noise: of the way from the cleanest to the
    # noisiest a share u becomes k u / (1 + (k - 1) u) (Esser et al. 2024).
    time_shift: float = 1.0

    def __post_init__(self):
        check_fields(self, infinite_allowed=("clip", "weight_cap"))
        for name in ("channels", "patch", "width", "depth", "repeats"):
            value = getattr(self, name)
            require(value >= 1, f"diffusion.{name} must be at least 1, got {value}")
        require(self.steps >= 2, f"diffusion.steps must be at least 2, got {self.steps}")
        require(self.clip > 0, f"diffusion.clip must be positive, got {self.clip}")
        require(self.weight_cap >= 0, f"diffusion.weight_cap must not be negative, got {self.weight_cap}")
        require(self.time_shift > 0, f"diffusion.time_shift must be positive, got {self.time_shift}")

    @property
    def cells(self) -> int:
        """Latent cells per token."""
        return self.patch**2

    @property
    def token_channels(self) -> int:
        """C: values per token."""
        return self.cells * self.channels


Conditioning = Literal["concat+modulate", "modulate", "concat", "add", "cross_attention"]
"""How actions reach the trunk (paper section 4.1, reference section 1.6): as K more tokens per
frame, through a shift and scale in every block, both, added to every token in every block, or
attended to in every block."""


@dataclass(frozen=True)
class ModelConfig:
    """The HMA transformer. Defaults are the released discrete base model (43.6 M, one robot).

    With `diffusion` set it is the continuous variant: tokens are latent vectors, and `factors`
    and `factor_vocab` mean nothing.
    """

    width: int = 256  # D: values of a token inside the trunk
    layers: int = 32  # N: blocks
    heads: int = 8  # H: attention heads of a block
    frames: int = 12  # T: of a window
    tokens: int = 256  # S: of a frame
    action_tokens: int = 64  # K: of a frame's actions, where conditioning has concat
    factors: int = 2  # Q: of a token's id
    factor_vocab: int = 512  # V: entries of a factor
    diffusion: DiffusionConfig | None = None  # of models on latents; null: on ids
    conditioning: Conditioning = "concat+modulate"  # how actions reach the trunk
    # Which chunk conditions frame t: the one executed after it (`released`; the chunk that led
    # to it then arrives through temporal attention) or the one that led to it (`causal`).
    action_alignment: Literal["released", "causal"] = "released"
    action_heads: bool = True  # what predicts actions; forward dynamics does without
    # Masked tokens are embedded as one learned vector and, with `recall`, the embedding of the same token a frame
    # earlier as well. DIFFERS: the release has the vector alone.
    recall: bool = False
    # A token's factors are drawn one after the other, each given those before it. DIFFERS: the release draws them as if
    # independent, so that where two tokens are likely it may show a third, made of a piece of each.
    chain_factors: bool = False
    mlp_ratio: float = 4.0  # width of a block's MLP over that of the trunk
    qkv_bias: bool = False  # of queries, keys and values
    proj_bias: bool = True  # of the projection that leaves attention
    mlp_bias: bool = True  # of both layers of the MLP
    qk_norm: bool = False  # norms of queries and keys
    trunk_gain: float = 0.1  # Xavier gain of trunk and modulation (reference section 1.10)
    stem_gain: float = 0.01  # Xavier gain of the action stems
    mup: MupConfig = field(default_factory=MupConfig)

    def __post_init__(self):
        check_fields(self)
        for name in ("width", "layers", "heads", "frames", "tokens", "factors", "action_tokens"):
            require(getattr(self, name) >= 1, f"model.{name} must be at least 1, got {getattr(self, name)}")
        require(
            self.width % self.heads == 0,
            f"model.width {self.width} is not a multiple of model.heads {self.heads}",
        )
        require(
            self.width * self.mlp_ratio >= 1,
            f"model.mlp_ratio {self.mlp_ratio} of model.width {self.width} leaves the MLP no width",
        )
        for name in ("trunk_gain", "stem_gain"):  # of matrices that are all zero no gradient leads away
            require(getattr(self, name) > 0, f"model.{name} must be positive, got {getattr(self, name)}")
        require(self.factor_vocab >= 2, f"model.factor_vocab must be at least 2, got {self.factor_vocab}")
        require(
            self.diffusion is not None or self.factors * math.log2(self.factor_vocab) <= 31,
            f"model.factors {self.factors} of model.factor_vocab {self.factor_vocab} entries make more ids than the {2**31} "
            "that an int32 tells apart",
        )
        require(
            not self.chain_factors or (self.factors > 1 and self.diffusion is None),
            "model.chain_factors needs ids of several factors: model.factors of at least 2 and no model.diffusion",
        )

    @property
    def head_width(self) -> int:
        return self.width // self.heads

    @property
    def mlp_width(self) -> int:
        return int(self.width * self.mlp_ratio)

    @property
    def concat(self) -> bool:
        """Whether actions enter as tokens of their own."""
        return "concat" in self.conditioning

    @property
    def frame_tokens(self) -> int:
        """P: tokens per frame inside the trunk."""
        return self.tokens + (self.action_tokens if self.concat else 0)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """(S,) of ids, or (S, C) of latents."""
        return (self.tokens, self.diffusion.token_channels) if self.diffusion else (self.tokens,)

    @property
    def position_slots(self) -> int:
        """Position embeddings kept per frame. As released there are some for latent cells that
        patches never reach, and for action tokens whether or not there are any."""
        cells = self.diffusion.cells if self.diffusion else 1
        return self.tokens * cells + self.action_tokens

    @property
    def vocab_size(self) -> int:
        return self.factor_vocab**self.factors

    @property
    def width_multiplier(self) -> float:
        """muP's m = D / base width; 1 when muP is off."""
        return self.width / self.mup.base_width if self.mup.enabled else 1.0

    def mup_multiplier(self, ingredient: str) -> float:
        """m where `ingredient` of muP applies, 1 where it was taken away."""
        return 1.0 if ingredient in self.mup.without else self.width_multiplier
