"""What a training run learns from, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from hma_jax.config.base import check_fields, later, require, require_seed
from hma_jax.config.model import ModelConfig

MaskingSetting = Literal["forward", "passive", "full", "policy", "inverse"]
"""What is hidden in training, and so predicted (paper section 3.1)."""

PREDICT_FRAMES: tuple[MaskingSetting, ...] = ("forward", "passive", "full")
PREDICT_ACTIONS: tuple[MaskingSetting, ...] = ("full", "policy", "inverse")

ActionLeak = Literal["none", "conditioning", "all"]
"""Where the model is shown actions that are hidden (`MaskingConfig.action_leak`)."""

Weights = Literal["auto", "last", "ema"]
"""Which weights of a run: the last ones, their moving average, or (`auto`) the average where the run
keeps one (`TrainConfig.ema_decay`)."""

Matrices = Literal["adamw", "muon"]
"""Optimisers of matrices from width to width, the trunk's and the robots' own."""

ActionScale = Literal["deviation", "quantiles"]
"""The scale of actions: standard deviations from their mean, or the scale on which their 1 % and 99 % quantiles are -1
and 1."""


@dataclass(frozen=True)
class MaskingConfig:
    """Training-time masking and corruption (reference sections 1.9 and 2.3, paper section 3.5)."""

    setting: MaskingSetting = "forward"  # what is masked in training, and so predicted (docs/models.md)
    # Weight of the action loss beside that of frames, if these are predicted too. DIFFERS: in the release's continuous
    # variant it is 1 by default; here 0.5 for both.
    action_loss_weight: float = 0.5
    non_mlm_ratio: float = 0.2  # probability that the prompt frames of a window are not masked
    prompt_frames: int = 4  # number of prompt frames, the first of a window
    # Mask rate of a frame: cos(pi/2 u), with u uniform between this value and 1. DIFFERS: the release calls
    # it the minimum mask ratio, but a larger value lowers the largest rate.
    mask_angle_min: float = 0.0
    # Lowest mask rate of a frame, in the schedule of paper section 3.5, which the release does not have; horizon_gain
    # raises it over the window. At 1 the last frame is fully masked.
    min_ratio: float = 0.0
    horizon_gain: float = 0.0  # by how much min_ratio rises from the first to the last frame of a window
    # Continuous variant: mask whole patches or single latent cells. DIFFERS: the release masks single cells (`cell`),
    # so that patches are partly masked in training but never at inference.
    mask_unit: Literal["patch", "cell"] = "patch"
    # Predict masked frames from the true frames before them, as in generation. DIFFERS: the release
    # masks all frames of a window in one pass, so that each is predicted from masked ones. A step passes over every
    # frame twice; docs/models.md shows when that pays.
    teacher_forcing: bool = False
    # With teacher forcing and discrete tokens: replace up to this share of the past frames by frames that the model
    # generated itself (scheduled sampling; `objective.own_past`). DIFFERS: the release corrupts the past only with
    # random tokens (`max_corrupt_rate`, which exists here too).
    own_past: float = 0.0
    # Rounds in which own_past generates frames, each from the frames of the round before; each round costs one more
    # pass over every frame per training step.
    own_past_rounds: int = later(1)
    # With teacher forcing: probability that a rectangle of the past shows, for some frames, the contents of another
    # place (`objective.displaced`). DIFFERS: the release has nothing like it.
    displaced_past: float = later(0.0)
    # Weight in the loss of discrete tokens that differ from the token at the same place one frame earlier; tokens that
    # do not change, most of a video, have weight 1. DIFFERS: the release weighs all tokens equally. Effect:
    # docs/models.md.
    change_weight: float = later(1.0)
    max_corrupt_rate: float = 0.2  # models on ids: largest share of tokens replaced by random ones
    # Models on ids: smallest share of tokens kept in the first frame after an unmasked prompt.
    clean_rate_min: float = 0.2
    label_smoothing: float = 0.01  # models on ids: share of the target that is spread evenly over all entries
    # Where hidden actions are still visible to the model: nowhere, in the blocks, or everywhere. DIFFERS: the release
    # shows them in the blocks (`conditioning`, discrete variant) or everywhere (`all`, continuous variant), so that the
    # model is given what it has to predict.
    action_leak: ActionLeak = "none"

    def __post_init__(self):
        check_fields(self)
        shares = ("non_mlm_ratio", "mask_angle_min", "min_ratio", "horizon_gain", "own_past", "displaced_past")
        for name in (*shares, "max_corrupt_rate", "clean_rate_min", "label_smoothing"):
            value = getattr(self, name)
            require(0.0 <= value <= 1.0, f"masking.{name} must lie in [0, 1], got {value}")
        require(
            self.label_smoothing < 1,
            "masking.label_smoothing must be below 1: at 1 the targets contain nothing of the labels",
        )
        require(
            self.mask_angle_min < 1 or self.min_ratio > 0 or self.horizon_gain > 0,
            "masking.mask_angle_min 1 masks no token, so nothing is learned; set it below 1, or masking.min_ratio "
            "above 0",
        )
        # The first frame is never masked: nothing comes before it.
        require(self.prompt_frames >= 1, f"masking.prompt_frames must be at least 1, got {self.prompt_frames}")
        require(self.action_loss_weight >= 0, "masking.action_loss_weight must not be negative")
        require(
            self.action_loss_weight > 0 or self.predicts_frames,
            f"masking.action_loss_weight is 0, and {self.setting!r} predicts only actions, so nothing would be "
            "learned; set it above 0",
        )
        require(self.own_past_rounds >= 1, f"masking.own_past_rounds must be at least 1, got {self.own_past_rounds}")
        require(self.change_weight > 0, f"masking.change_weight must be positive, got {self.change_weight}")
        require(
            self.change_weight == 1 or self.predicts_frames,
            f"masking.change_weight is the weight of predicted tokens, but setting {self.setting!r} predicts no "
            "frames; leave it at 1",
        )
        require(
            self.action_leak == "none" or not self.ignores_actions,
            f"masking.action_leak {self.action_leak!r} shows the actions that setting {self.setting!r} hides, but a "
            "model trained for it is used without actions; set masking.setting=forward, or masking.action_leak=none",
        )
        require(
            not (self.teacher_forcing and self.predicts_actions),
            f"masking.teacher_forcing works only with settings that predict no actions, but {self.setting!r} predicts "
            "actions",
        )
        require(
            self.teacher_forcing or not self.own_past,
            "masking.own_past needs masking.teacher_forcing=true, whose past frames it replaces",
        )
        require(
            self.teacher_forcing or not self.displaced_past,
            "masking.displaced_past needs masking.teacher_forcing=true, whose past frames it changes",
        )
        require(
            self.own_past > 0 or self.own_past_rounds == 1,
            f"masking.own_past_rounds {self.own_past_rounds} has no effect while masking.own_past is 0; set "
            "masking.own_past above 0",
        )

    @property
    def predicts_frames(self) -> bool:
        return self.setting in PREDICT_FRAMES

    @property
    def predicts_actions(self) -> bool:
        return self.setting in PREDICT_ACTIONS

    @property
    def shows_all_actions(self) -> bool:
        """Whether no recorded action is hidden."""
        return self.setting == "forward"

    @property
    def hides_all_actions(self) -> bool:
        return self.setting in ("passive", "inverse")

    @property
    def ignores_actions(self) -> bool:
        """Whether frames are predicted without actions, so that actions have no effect."""
        return self.predicts_frames and self.hides_all_actions


# --- Training --------------------------------------------------------------------------------


@dataclass(frozen=True)
class OptimizerConfig:
    # Peak learning rate, at the muP base width. DIFFERS: the release multiplies the configured rate by batch / 64,
    # between 1 and 8; here it is used as configured.
    learning_rate: float = 1e-4
    schedule: Literal["constant", "cosine", "wsd"] = "constant"  # learning-rate schedule after the warm-up
    warmup_steps: int = 500  # steps in which the learning rate rises from 0
    final_fraction: float = 0.1  # cosine and wsd: learning rate right after the last step, as a fraction of the peak
    decay_fraction: float = 0.2  # wsd: length of the decay phase, as a fraction of all steps
    beta1: float = 0.9  # AdamW: decay rate of the first moment
    beta2: float = 0.95  # AdamW: decay rate of the second moment
    epsilon: float = 1e-8  # AdamW: term added to the denominator
    # Weight decay of all parameters except biases, as released: it also applies to gains and to position and token
    # embeddings.
    weight_decay: float = 0.05
    clip_norm: float = 1.0  # gradients with a larger norm are scaled down to it
    # Optimiser of matrices from width to width, the trunk's and the robots' own: AdamW, as for all other parameters, or
    # Muon, which orthogonalises their momentum (Jordan et al. 2024). DIFFERS: the release has only AdamW. What Muon
    # gains: docs/models.md.
    matrices: Matrices = later("adamw")

    def __post_init__(self):
        check_fields(self, infinite_allowed=("clip_norm",))
        require(self.learning_rate > 0, f"optimizer.learning_rate must be positive, got {self.learning_rate}")
        require(self.warmup_steps >= 0, "optimizer.warmup_steps must not be negative")
        require(self.clip_norm > 0, f"optimizer.clip_norm must be positive, got {self.clip_norm}")
        for name in ("beta1", "beta2"):
            require(0 <= getattr(self, name) < 1, f"optimizer.{name} must lie in [0, 1), got {getattr(self, name)}")
        for name in ("final_fraction", "decay_fraction"):
            require(0 <= getattr(self, name) <= 1, f"optimizer.{name} must lie in [0, 1], got {getattr(self, name)}")
        require(
            self.schedule != "wsd" or self.decay_fraction > 0,
            "optimizer.decay_fraction is 0, so schedule wsd never decays; set it above 0, or set "
            "optimizer.schedule=constant",
        )
        require(self.epsilon > 0, f"optimizer.epsilon must be positive, got {self.epsilon}")
        require(self.weight_decay >= 0, f"optimizer.weight_decay must not be negative, got {self.weight_decay}")


@dataclass(frozen=True)
class TrainConfig:
    """One training run. `batch` counts windows per optimiser step, over all devices."""

    steps: int = 60_000  # number of optimiser steps
    batch: int = 64  # windows per step, over all devices
    seed: int = 0  # random seed of initial values, masks and order of data
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    masking: MaskingConfig = field(default_factory=MaskingConfig)
    only: tuple[str, ...] = ()  # train only these robots' own parameters; []: train everything
    # Decay rate of a moving average of the weights, which is kept beside them; 0: none. The rate rises to this value,
    # which a short run does not reach: after t steps it is at most (1 + t) / (10 + t), such as 0.99 after 890 steps and
    # 0.999 after 8,990.
    ema_decay: float = 0.0
    action_scale: ActionScale = "deviation"  # how actions of new robots are normalised

    def __post_init__(self):
        check_fields(self)
        require(self.steps >= 1, f"train.steps must be at least 1, got {self.steps}")
        require(self.batch >= 1, f"train.batch must be at least 1, got {self.batch}")
        require_seed(self.seed, "train.seed")
        require(0 <= self.ema_decay < 1, f"train.ema_decay must lie in [0, 1), got {self.ema_decay}")


# --- What must fit each other ------------------------------------------------------------------


def check_objective(model: ModelConfig, masking: MaskingConfig) -> None:
    """Raises ConfigError for an objective that `model` cannot be trained for."""
    setting = masking.setting
    require(
        model.action_heads or not masking.predicts_actions,
        f"train.masking.setting {setting!r} predicts actions, but the model has no action heads; set "
        "model.action_heads=true",
    )
    require(
        model.concat or not masking.predicts_actions,
        f"train.masking.setting {setting!r} predicts actions from action tokens, but model.conditioning "
        f"{model.conditioning!r} has none; choose one with concat",
    )
    require(
        model.frames > 1 or setting == "policy",
        f"with model.frames 1 no frame follows another, so train.masking.setting {setting!r} has nothing to predict; "
        "set model.frames to at least 2",
    )
    require(
        model.diffusion is None or not masking.own_past,
        "train.masking.own_past works only for models on ids, not on latents; set it to 0",
    )
    require(
        model.diffusion is None or masking.change_weight == 1,
        "train.masking.change_weight works only for models on ids: latents change everywhere; set it to 1",
    )
    require(
        not masking.displaced_past or math.isqrt(model.tokens) ** 2 == model.tokens,
        f"train.masking.displaced_past needs square frames, but model.tokens {model.tokens} is not a square number",
    )


def check_micro_batches(batch: int, accumulate: int) -> None:
    """Raises ConfigError for a batch that does not split into so many micro-batches."""
    require(batch % accumulate == 0, f"train.batch {batch} is not a multiple of execution.accumulate {accumulate}")
