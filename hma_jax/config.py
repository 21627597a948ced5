"""Configuration: frozen dataclasses, validated when made.

A default lives here and nowhere else; those of tokenizers that are not trained here are in
`tokenizers.config`. Named instances live in `presets`, JSON and hashes in `config_json`. A
config holds what determines a result; paths, clocks and verbosity belong to the code that calls.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


class ConfigError(ValueError):
    """A configuration that cannot work; the message names the field and what to change."""


def require(condition: bool, message: str) -> None:
    """Raises ConfigError(message) unless `condition` holds."""
    if not condition:
        raise ConfigError(message)


# --- Tokenizer -------------------------------------------------------------------------------


@dataclass(frozen=True)
class TokenizerConfig:
    """The small convolutional tokenizer, with lookup-free quantisation or without.

    An image of `image_size` x `image_size` becomes (image_size / downsample)^2 tokens. Quantised
    (`tokenizers.lfq`), a token is an id of `bits` binary channels, split evenly into `factors`
    vocabulary factors. Otherwise (`tokenizers.continuous`) it is a vector of `bits` real
    channels; `factors`, the entropy and the commitment then mean nothing.
    """

    image_size: int = 32
    downsample: int = 8
    quantise: bool = True
    bits: int = 16  # channels per token: C of the continuous variant
    factors: int = 2
    channels: int = 256
    encoder_blocks: int = 1
    decoder_blocks: int = 2
    entropy_weight: float = 0.0
    entropy_temperature: float = 1.0  # of the soft code assignment that the entropy is taken of
    commitment_weight: float = 0.0
    # Without quantisation: noise on the latents while training, its standard deviation in the
    # range -1..1 of the encoder. It makes the decoder bear the errors of a generative model: on
    # the suite 0.1 costs 0.6 dB without errors and gains 1.7 dB where they are 0.2 (of latents
    # scaled to 1); 0.2 costs 1.3 dB and is better only from errors of 0.3 on.
    latent_noise: float = 0.1

    def __post_init__(self):
        d = self.downsample
        require(d >= 2 and d & (d - 1) == 0, f"tokenizer.downsample must be a power of two, got {d}")
        require(
            self.image_size % d == 0,
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
            f"tokenizer.bits {self.bits} do not split into {self.factors} equal factors",
        )
        require(self.bits <= 24, f"tokenizer.bits must be at most 24, got {self.bits}")
        require(
            self.bits // self.factors <= 12,
            f"tokenizer.factors {self.factors}: a factor of {self.bits // self.factors} bits is too wide "
            "for the entropy loss (at most 12); use more factors",
        )

    @property
    def grid(self) -> int:
        """Tokens along one side of the image."""
        return self.image_size // self.downsample

    @property
    def tokens(self) -> int:
        """S: tokens per frame."""
        return self.grid**2

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

    steps: int = 2000
    batch: int = 64
    learning_rate: float = 3e-3
    warmup_steps: int = 50
    final_fraction: float = 0.01  # of the learning rate, at the end of the cosine
    weight_decay: float = 1e-4
    clip_norm: float = 1.0
    seed: int = 0

    def __post_init__(self):
        require(self.steps >= 1, f"tokenizer training: steps must be at least 1, got {self.steps}")
        require(self.batch >= 1, f"tokenizer training: batch must be at least 1, got {self.batch}")
        require(
            self.learning_rate > 0,
            f"tokenizer training: learning_rate must be positive, got {self.learning_rate}",
        )
        require(self.warmup_steps >= 0, "tokenizer training: warmup_steps must not be negative")
        require(self.clip_norm > 0, "tokenizer training: clip_norm must be positive")


# --- Model -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class MupConfig:
    """Width transfer (paper section 3.5; practice in Tensor Programs V).

    `base_width` is where the multipliers are 1. Learning rate and initial variance of hidden
    matrices scale with base_width / D, the read-out's input with base_width / D, attention
    logits with `attention_scale` / head width. `without` takes single ingredients away, to show
    that each is needed.
    """

    enabled: bool = True
    base_width: int = 256
    attention_scale: float = 8.0
    without: tuple[Literal["init", "learning_rate", "readout", "attention"], ...] = ()


@dataclass(frozen=True)
class DiffusionConfig:
    """Diffusion over continuous vectors conditioned on the trunk (reference sections 2.4 and 2.5).

    `channels` and `patch` describe what is denoised for frames: a token is a patch of
    `patch` x `patch` latent cells of `channels` values, flattened to C = patch^2 x channels.
    """

    channels: int = 4
    patch: int = 2
    width: int = 1024  # of the denoising network
    depth: int = 4  # its residual blocks
    steps: int = 1000  # of the noising process
    clip: float = 10.0  # predicted clean values are kept in +-clip while sampling
    repeats: int = 1  # noised copies of each token per training step

    def __post_init__(self):
        for name in ("channels", "patch", "width", "depth", "steps", "repeats"):
            value = getattr(self, name)
            require(value >= 1, f"diffusion.{name} must be at least 1, got {value}")
        require(self.clip > 0, f"diffusion.clip must be positive, got {self.clip}")

    @property
    def cells(self) -> int:
        """Latent cells per token."""
        return self.patch**2

    @property
    def token_channels(self) -> int:
        """C: values per token."""
        return self.cells * self.channels


@dataclass(frozen=True)
class SamplerConfig:
    """How clean vectors are drawn (`diffusion.sample`).

    `ddpm` is ancestral sampling, as released; `ddim` (eta 0), as the paper states, draws nothing
    after the initial noise. `temperature` multiplies noise; 0 leaves what the condition implies.
    """

    kind: Literal["ddpm", "ddim"] = "ddpm"
    steps: int = 100  # of the respaced process
    temperature: float = 1.0
    # DIFFERS: the release multiplies the noise of the steps only, so that at "temperature 0" its
    # samples still depend on the random numbers they start from; False: as released.
    scale_initial_noise: bool = True

    def __post_init__(self):
        require(self.steps >= 2, f"sampler.steps must be at least 2, got {self.steps}")
        require(self.temperature >= 0, f"sampler.temperature must not be negative, got {self.temperature}")
        require(
            self.kind == "ddpm" or self.scale_initial_noise or self.temperature == 1,
            "sampler.temperature has no effect on ddim without scale_initial_noise; "
            "set scale_initial_noise or leave the temperature at 1",
        )

    @property
    def noisy_steps(self) -> bool:
        """Whether the steps after the first need random numbers."""
        return self.kind == "ddpm" and self.temperature > 0


@dataclass(frozen=True)
class DecodeConfig:
    """How a masked frame is filled (`decoding`).

    `temperature` divides the logits of discrete tokens; 0 takes the most likely entry of each
    factor. DIFFERS: the release divides probabilities, which a renormalising draw ignores
    (reference section 3.2). Continuous tokens have the `sampler` and its own temperature.
    """

    unmask_steps: int = 2  # M
    temperature: float = 0.0
    top_k: int = 0  # draw from the k likeliest entries of each factor; 0: from all
    order: Literal["random", "confidence"] = "random"  # in which tokens are unmasked
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    resample: bool = False  # continuous: predict every patch again in each step, as released
    # What happens past the window of T frames: `exact` computes the window again for every frame;
    # `streaming` keeps what was computed when its frames stood elsewhere, an approximation.
    slide: Literal["exact", "streaming"] = "exact"

    def __post_init__(self):
        require(self.unmask_steps >= 1, f"decode.unmask_steps must be at least 1, got {self.unmask_steps}")
        require(self.temperature >= 0, f"decode.temperature must not be negative, got {self.temperature}")
        require(self.top_k >= 0, f"decode.top_k must not be negative, got {self.top_k}")


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

    width: int = 256  # D
    layers: int = 32  # N
    heads: int = 8  # H
    frames: int = 12  # T
    tokens: int = 256  # S
    action_tokens: int = 64  # K
    factors: int = 2  # Q
    factor_vocab: int = 512  # V
    diffusion: DiffusionConfig | None = None
    conditioning: Conditioning = "concat+modulate"
    # Which chunk conditions frame t: the one executed after it (`released`; the chunk that led
    # to it then arrives through temporal attention) or the one that led to it (`causal`).
    action_alignment: Literal["released", "causal"] = "released"
    action_heads: bool = True  # what predicts actions; forward dynamics does without
    mlp_ratio: float = 4.0
    qkv_bias: bool = False
    proj_bias: bool = True
    mlp_bias: bool = True
    qk_norm: bool = False
    trunk_gain: float = 0.1  # Xavier gain of trunk and modulation (reference section 1.10)
    stem_gain: float = 0.01  # Xavier gain of the action stems
    mup: MupConfig = field(default_factory=MupConfig)
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    remat: bool = True  # keep no more than a block's input for the backward pass; False: its products too
    # Large frames attend one at a time on CPU (`by_frame`), or all at once (`whole`, to compare with).
    attention: Literal["by_frame", "whole"] = "by_frame"

    def __post_init__(self):
        require(
            self.width % self.heads == 0,
            f"model.width {self.width} is not a multiple of model.heads {self.heads}",
        )
        for name in ("width", "layers", "heads", "frames", "tokens", "factors", "action_tokens"):
            require(getattr(self, name) >= 1, f"model.{name} must be at least 1, got {getattr(self, name)}")
        require(self.factor_vocab >= 2, f"model.factor_vocab must be at least 2, got {self.factor_vocab}")

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


Setting = Literal["forward", "passive", "full", "policy", "inverse"]
"""What is hidden in training, and so predicted (paper section 3.1)."""


@dataclass(frozen=True)
class MaskingConfig:
    """Training-time masking and corruption (reference sections 1.9 and 2.3)."""

    setting: Setting = "forward"
    action_loss_weight: float = 0.5
    non_mlm_ratio: float = 0.2  # probability that prompt frames stay clean
    prompt_frames: int = 4
    # A frame's mask rate is cos(pi/2 u) with u uniform from here to 1. DIFFERS: the release calls
    # it the minimum mask ratio, but a larger value lowers the largest rate.
    mask_angle_min: float = 0.0
    # Continuous variant: mask whole patches. DIFFERS: the release masks single cells, so that
    # patches are partly masked in training and never at inference; `cell` is as released.
    mask_unit: Literal["patch", "cell"] = "patch"
    max_corrupt_rate: float = 0.2
    clean_rate_min: float = 0.2
    label_smoothing: float = 0.01
    # DIFFERS: the release shows hidden actions to the blocks (`conditioning`, discrete variant)
    # or everywhere (`all`, continuous variant), so that the objective gives them away.
    action_leak: Literal["none", "conditioning", "all"] = "none"

    def __post_init__(self):
        for name in ("non_mlm_ratio", "mask_angle_min", "max_corrupt_rate", "clean_rate_min", "label_smoothing"):
            value = getattr(self, name)
            require(0.0 <= value <= 1.0, f"masking.{name} must lie in [0, 1], got {value}")
        require(self.action_loss_weight >= 0, "masking.action_loss_weight must not be negative")

    @property
    def predicts_frames(self) -> bool:
        return self.setting in ("forward", "passive", "full")

    @property
    def predicts_actions(self) -> bool:
        return self.setting in ("full", "policy", "inverse")


# --- Training --------------------------------------------------------------------------------


@dataclass(frozen=True)
class OptimizerConfig:
    learning_rate: float = 1e-4  # at the muP base width
    schedule: Literal["constant", "cosine", "wsd"] = "constant"
    warmup_steps: int = 500
    final_fraction: float = 0.1  # of the learning rate, at the end of cosine and wsd
    decay_fraction: float = 0.2  # of all steps, the decay phase of wsd
    beta1: float = 0.9
    beta2: float = 0.95
    epsilon: float = 1e-8
    weight_decay: float = 0.05
    clip_norm: float = 1.0

    def __post_init__(self):
        require(self.learning_rate > 0, f"optimizer.learning_rate must be positive, got {self.learning_rate}")
        require(self.warmup_steps >= 0, "optimizer.warmup_steps must not be negative")
        require(self.clip_norm > 0, f"optimizer.clip_norm must be positive, got {self.clip_norm}")


@dataclass(frozen=True)
class MeshConfig:
    """Devices along each mesh axis; -1 on one axis takes all that are left."""

    data: int = -1
    fsdp: int = 1
    tensor: int = 1
    min_shard_size: int = 2**14  # smaller parameters stay whole on every device

    def __post_init__(self):
        sizes = (self.data, self.fsdp, self.tensor)
        require(sizes.count(-1) <= 1, f"mesh: only one axis may be -1, got {sizes}")
        require(all(s == -1 or s >= 1 for s in sizes), f"mesh axes must be -1 or at least 1, got {sizes}")


@dataclass(frozen=True)
class TrainConfig:
    """One training run. `batch` counts windows per optimiser step, over all devices."""

    steps: int = 60_000
    batch: int = 64
    accumulate: int = 1  # micro-batches per step
    seed: int = 0
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    masking: MaskingConfig = field(default_factory=MaskingConfig)
    only: tuple[str, ...] = ()  # train these robots' own parameters and nothing else; (): everything

    def __post_init__(self):
        require(self.steps >= 1, f"train.steps must be at least 1, got {self.steps}")
        require(
            self.batch % self.accumulate == 0,
            f"train.batch {self.batch} is not a multiple of train.accumulate {self.accumulate}",
        )


@dataclass(frozen=True)
class EvalConfig:
    """The evaluation protocol (paper section 4, Metrics)."""

    windows_per_dataset: int = 500
    # What a predicted frame follows: frames the model made, from a prompt on, or (`recorded`, as the
    # release judges) in every case the recorded ones.
    context: Literal["generated", "recorded"] = "generated"
    prompt_frames: int = 4
    # Continuous tokens: the mean of each diffusion step, not a draw.
    decode: DecodeConfig = field(default_factory=lambda: DecodeConfig(sampler=SamplerConfig(temperature=0.0)))
    random_actions: int = 5  # draws for delta PSNR
    batch: int = 32
    perplexity_group: int = 4  # windows per exp(mean), as in the official evaluation
    seed: int = 0

    def __post_init__(self):
        require(self.windows_per_dataset >= 1, "eval.windows_per_dataset must be at least 1")
        require(self.prompt_frames >= 1, "eval.prompt_frames must be at least 1")
        require(self.random_actions >= 1, "eval.random_actions must be at least 1")

    @property
    def first_predicted(self) -> int:
        """The first frame of a window that is compared."""
        return self.prompt_frames if self.context == "generated" else 1
