"""What the transformer is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from hma_jax.config.base import check_fields, later, require


@dataclass(frozen=True)
class MupConfig:
    """Width transfer (paper section 3.5; practice in Tensor Programs V).

    `base_width` is the width at which the multipliers are 1. Learning rate and initial variance of hidden matrices
    scale with base_width / D, the read-out's input with base_width / D, attention logits with `attention_scale` / head
    width. `without` switches off single ingredients, to show that each is needed.
    """

    enabled: bool = True  # use muP: scale learning rates, initial values and logits with the width
    base_width: int = 256  # width at which all muP multipliers are 1
    attention_scale: float = 8.0  # attention logits are scaled by this, divided by the width of a head
    without: tuple[Literal["init", "learning_rate", "readout", "attention"], ...] = ()  # parts of muP to switch off

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

    channels: int = 4  # values per latent cell
    patch: int = 2  # side of a token in latent cells
    width: int = 1024  # width of the denoising network
    depth: int = 4  # residual blocks of the denoising network
    steps: int = 1000  # steps of the noising process
    clip: float = 10.0  # predicted clean values are kept in +-clip while sampling
    repeats: int = 1  # noised copies of each token per training step
    # Weight of a noising step in the training loss: 0, all steps count alike, as released (squared error of the noise);
    # above 0, noise over signal, at most this (squared error of the clean vector, so noisy steps count most).
    weight_cap: float = later(0.0)
    # Shift k of the noising steps that are drawn in training: 1, uniform, as released; larger, towards noise (a uniform
    # position u becomes k u / (1 + (k - 1) u); Esser et al. 2024). Whole steps are moved, so many are never drawn (of
    # 1000 a third at k = 4, among them the first, with which every sampler ends).
    time_shift: float = later(1.0)
    # The same shift of the position before it becomes a step: every step is drawn. Not measured to be better.
    noise_shift: float = later(1.0)

    def __post_init__(self):
        check_fields(self, infinite_allowed=("clip", "weight_cap"))
        for name in ("channels", "patch", "width", "depth", "repeats"):
            value = getattr(self, name)
            require(value >= 1, f"diffusion.{name} must be at least 1, got {value}")
        require(self.steps >= 2, f"diffusion.steps must be at least 2, got {self.steps}")
        require(self.clip > 0, f"diffusion.clip must be positive, got {self.clip}")
        require(self.weight_cap >= 0, f"diffusion.weight_cap must not be negative, got {self.weight_cap}")
        for name in ("noise_shift", "time_shift"):
            require(getattr(self, name) > 0, f"diffusion.{name} must be positive, got {getattr(self, name)}")
        require(
            1 in (self.noise_shift, self.time_shift),
            "diffusion.time_shift and diffusion.noise_shift are two ways of one shift; set only one of them, the other to 1",
        )

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

    width: int = 256  # D: width of the trunk, values per token
    layers: int = 32  # N: number of blocks
    heads: int = 8  # H: attention heads per block
    frames: int = 12  # T: frames per window
    tokens: int = 256  # S: tokens per frame
    action_tokens: int = 64  # K: action tokens per frame, if conditioning contains concat
    factors: int = 2  # Q: factors that a token's id is split into
    factor_vocab: int = 512  # V: vocabulary size of each factor
    diffusion: DiffusionConfig | None = None  # diffusion heads, for models on latents; null: a model on ids
    conditioning: Conditioning = "concat+modulate"  # how the trunk is conditioned on actions
    # Which action chunk conditions frame t: the one executed after it (`released`; the chunk that led
    # to it is then seen through temporal attention) or the one that led to it (`causal`).
    action_alignment: Literal["released", "causal"] = "released"
    action_heads: bool = True  # whether the model has heads that predict actions; forward dynamics needs none
    # Add to the embedding of a masked token that of the token at the same position one frame earlier, so that the first
    # block already sees what is to move. DIFFERS: in the release masked tokens are only one learned vector.
    recall: bool = later(False)
    # Predict a token's factors one after the other, each given those before it. DIFFERS: the release draws them as if
    # they were independent. Where two tokens are likely, it may then show a third one, made of a part of each.
    chain_factors: bool = later(False)
    mlp_ratio: float = 4.0  # width of a block's MLP, as a multiple of the trunk's
    qkv_bias: bool = False  # biases of queries, keys and values
    proj_bias: bool = True  # biases of attention's output projection
    mlp_bias: bool = True  # biases of both layers of the MLP
    qk_norm: bool = False  # normalise queries and keys
    trunk_gain: float = 0.1  # Xavier gain of the initial values of trunk and modulation (reference section 1.10)
    stem_gain: float = 0.01  # Xavier gain of the initial values of the action stems
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
            f"model.mlp_ratio {self.mlp_ratio} makes the MLP of model.width {self.width} less than 1 wide; increase it",
        )
        for name in ("trunk_gain", "stem_gain"):  # matrices that are all zero would get no gradient
            require(getattr(self, name) > 0, f"model.{name} must be positive, got {getattr(self, name)}")
        require(self.factor_vocab >= 2, f"model.factor_vocab must be at least 2, got {self.factor_vocab}")
        require(
            self.diffusion is not None or self.factors * math.log2(self.factor_vocab) <= 31,
            f"model.factors {self.factors} with model.factor_vocab {self.factor_vocab} give more than {2**31} ids, "
            "the most that fit in an int32",
        )
        require(
            not self.chain_factors or (self.factors > 1 and self.diffusion is None),
            "model.chain_factors needs model.factors of at least 2 and model.diffusion=null: ids with several factors",
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
        return "concat" in self.conditioning.split("+")

    @property
    def block_conditioning(self) -> str | None:
        """How actions act inside every block (`model.conditioning.IN_BLOCKS`); None: they enter only as tokens."""
        return "+".join(way for way in self.conditioning.split("+") if way != "concat") or None

    @property
    def frame_tokens(self) -> int:
        """P: tokens per frame inside the trunk."""
        return self.tokens + (self.action_tokens if self.concat else 0)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """(S,) of ids, or (S, C) of latents."""
        return (self.tokens, self.diffusion.token_channels) if self.diffusion else (self.tokens,)

    @property
    def frame_dtype(self) -> Literal["int32", "float32"]:
        """Type of ids, or of latents."""
        return "float32" if self.diffusion else "int32"

    @property
    def position_slots(self) -> int:
        """Position embeddings kept per frame. As released, there is one for every latent cell, although patches use
        fewer, and one for every action token, whether or not actions enter as tokens."""
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
        """m where `ingredient` of muP applies, 1 where it is switched off."""
        return 1.0 if ingredient in self.mup.without else self.width_multiplier
