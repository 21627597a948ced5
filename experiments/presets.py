"""Named studies and nothing else. `Study` says what each field means."""

from __future__ import annotations

import math
from dataclasses import replace

from data_pipelines.registry.mixtures import FORTY
from data_pipelines.suite.embodiments import UNSEEN
from experiments.study import DesignConfig, StoreConfig, Study, SuiteConfig, TransferConfig
from hma_jax.config import (
    ConfigError,
    DecodeConfig,
    DiffusionConfig,
    EvalConfig,
    ExecutionConfig,
    Magvit2Config,
    MaskingConfig,
    ModelConfig,
    MupConfig,
    OptimizerConfig,
    SamplerConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
    TrainConfig,
)

SMOKE = Study(
    name="smoke",  # seconds: proves that every part runs; its numbers mean nothing
    suite=SuiteConfig(scale=0.02, validation=4),
    tokenizer=TokenizerConfig(image_size=16, downsample=4, bits=8, channels=16),
    tokenizer_train=TokenizerTrainConfig(steps=3, batch=4),
    model=ModelConfig(
        width=16,
        layers=2,
        heads=2,
        frames=4,
        tokens=16,
        action_tokens=2,
        factor_vocab=16,
        action_heads=False,
        mup=MupConfig(base_width=16),
    ),
    train=TrainConfig(
        steps=3,
        batch=4,
        optimizer=OptimizerConfig(learning_rate=1e-3, warmup_steps=1),
        masking=MaskingConfig(prompt_frames=2),
    ),
    eval=EvalConfig(
        windows_per_dataset=2, prompt_frames=2, random_actions=1, other_actions=2, batch=2, perplexity_group=1
    ),
    dataset_counts=(2, 3),
    trajectory_counts=(2, 4),
    widths=(8, 16),
    ablation_seeds=(0, 1),
    transfer=TransferConfig(rates=3, widths=(8, 16, 32), datasets=1),
    designs=DesignConfig(
        judged=2,
        counts=(2, 3),
        poor=2,
        shots=(1, 2),
        shots_after=(2, 3),
        shots_steps=2,
        caps=(1, 2),
        budgets=(2, 3),
        compute=(2, 3),
        rate_factors=(0.5, 1.0),
    ),
    flops_per_second=2e9,
    trial_seconds=15.0,
)

CPU = Study(
    name="cpu",  # the study of the README: two cores, minutes
    suite=SuiteConfig(scale=1.0),
    store=StoreConfig(min_val=8),
    # 30 dB on held-out frames and 26 on the parts that change; 16 tokens of 24 bits reach 25 and 22. Four factors of 16
    # entries are learned from half as many windows as two of 256: rollouts are as good after 2,500 steps as after
    # 5,000, and follow actions as well. The price is a perplexity that is higher: factors count as independent.
    tokenizer=TokenizerConfig(image_size=32, downsample=4, bits=16, factors=4),
    tokenizer_train=TokenizerTrainConfig(steps=4000, batch=32),
    model=ModelConfig(
        width=48,
        layers=2,
        heads=2,
        frames=12,
        tokens=64,
        action_tokens=1,
        factors=4,
        factor_vocab=16,
        action_heads=False,
        mup=MupConfig(base_width=48),
        # Ten thousand windows must suffice where the release has millions. Therefore residual branches and stems do not
        # start near zero, and each frame is given with the chunk that leads to it.
        trunk_gain=0.5,
        stem_gain=1.0,
        action_alignment="causal",
    ),
    execution=ExecutionConfig(remat="none"),
    train=TrainConfig(
        steps=2500,
        batch=4,  # the same number of windows in larger batches teaches less
        optimizer=OptimizerConfig(learning_rate=4e-3, warmup_steps=30, schedule="wsd", final_fraction=0.05),
        masking=MaskingConfig(max_corrupt_rate=0.0, non_mlm_ratio=0.0),
    ),
    # Each other action sequence costs a seventh of an evaluation without any. Three make a trial's evaluation take a
    # third longer and show whether actions are followed; retrieval among sixteen needs fifteen.
    eval=EvalConfig(windows_per_dataset=8, batch=8, other_actions=3),
    dataset_counts=(5, 20, 40),
    trajectory_counts=(4, 32, 500),
    widths=(16, 32, 48),
    transfer=TransferConfig(datasets=10, steps=1200),
    flops_per_second=2.5e10,
    trial_seconds=60.0,
)

CPU_FULL = replace(
    CPU,
    name="cpu-full",  # the evidence: two cores, 17 hours; every point with three seeds, every axis with controls
    # From 128 to 2,000 trajectories: with at least 128, no robot's data is memorised within the long runs
    # (docs/designs.md).
    suite=SuiteConfig(scale=4.0, fewest=128),
    trajectory_counts=(2000,),
    unseen=tuple(e.name for e in UNSEEN),
    # Teacher forcing: with the released objective, perplexity of a true past stops falling (docs/models.md).
    train=replace(CPU.train, steps=4000, masking=replace(CPU.train.masking, teacher_forcing=True)),
    eval=replace(CPU.eval, other_actions=15),  # retrieval among sixteen, for the reference
    tau=1000.0,  # every robot has the same weight, whichever others there are and however much data each has
    seeds=(0, 1, 2),
    widths=(16, 24, 32, 48, 64),  # over a decade of trunk parameters
    # From the study's own rate to eight times that: with 500 steps the best rates are higher than with 4,000.
    transfer=TransferConfig(rates=7, factor=math.sqrt(2), shift=3, widths=(16, 48, 64), datasets=10, steps=500),
    designs=DesignConfig(
        budgets=(500, 1000, 2000, 4000, 8000, 16_000), long=(32_000,), compute=(500, 1000, 2000, 4000),
        ablation_steps=2000, shots_steps=500, end_controls=True, other_actions=3, rate_factors=(1.0, 2.0, 4.0),
    ),
    axes=(
        "horizon", "dilution", "transfer", "newcomers", "episodes", "width", "compute", "lr", "lr_horizon", "fewshot",
        "settings", "conditioning",
    ),
)  # fmt: skip

SMALL_EPSILON = 1e-12
"""AdamW's epsilon for the released gains. DIFFERS: the release has 1e-8. The conditioning's matrices start near zero,
one behind the other: the median root mean square of their gradients is 2e-10 in the first step and still 1e-8 in the
200th (measured at width 256 with two layers, eight robots and as many windows). With 1e-8 they would move at first
at 2 % of the rate that muP assumes, and at half of it later."""

ACCELERATOR = Study(
    name="accelerator",  # one GPU
    suite=SuiteConfig(scale=20.0),
    tokenizer=TokenizerConfig(image_size=64, downsample=8, bits=16, channels=512),
    tokenizer_train=TokenizerTrainConfig(steps=10_000, batch=128, learning_rate=5e-4),
    model=ModelConfig(
        width=256,
        layers=12,
        heads=8,
        frames=12,
        tokens=64,
        action_tokens=16,
        factor_vocab=256,
        action_heads=False,
    ),
    execution=ExecutionConfig("bfloat16"),
    train=TrainConfig(
        steps=20_000,
        batch=64,
        optimizer=OptimizerConfig(learning_rate=5e-4, schedule="wsd", epsilon=SMALL_EPSILON),
    ),
    eval=EvalConfig(windows_per_dataset=200, batch=64),
    dataset_counts=(5, 10, 20, 30, 40),
    trajectory_counts=(10, 30, 100, 300, 1000),
    widths=(64, 128, 256, 512),
    seeds=(0, 1, 2),
    transfer=TransferConfig(steps=4000),
    flops_per_second=1e14,  # of an H100 at width 256 (docs/performance.md); elsewhere, time one trial and --set it
)

PAPER = Study(
    # Paper section 4, as stated: bring the forty datasets with --data and the tokenizer, 1X's, with --tokenizer. One
    # seed, as there; several with --set seeds=0,1,2. The largest model of figure 6 is width 768.
    name="paper",
    datasets=FORTY,
    tokenizer=Magvit2Config(),
    model=ModelConfig(action_heads=False),
    execution=ExecutionConfig("bfloat16"),
    train=TrainConfig(steps=60_000, batch=64, optimizer=OptimizerConfig(epsilon=SMALL_EPSILON)),
    eval=EvalConfig(windows_per_dataset=500),
    # Every native frame: the published mixture counts the windows that start at any of them.
    store=StoreConfig(val_fraction=0.01, max_val=500, frame_step=1),
    dataset_counts=(5, 10, 20, 30, 40),
    trajectory_counts=(10, 100, 1_000, 10_000, 100_000, 1_000_000),
    judged="drawn",  # on five robots, drawn with this seed
    widths=(64, 128, 256, 512, 768),
    transfer=TransferConfig(widths=(64, 256, 768), steps=6000),
    tau=3.0,
    flops_per_second=1e14,
)

SMOKE_CONTINUOUS = replace(
    SMOKE,
    name="smoke-continuous",
    tokenizer=replace(SMOKE.tokenizer, quantise=False),
    model=replace(SMOKE.model, diffusion=DiffusionConfig(channels=8, patch=1, width=16, depth=1)),
    eval=replace(SMOKE.eval, decode=DecodeConfig(sampler=SamplerConfig(steps=3, temperature=0.0))),
)

CPU_CONTINUOUS = replace(
    CPU,
    name="cpu-continuous",  # the same study on latents instead of ids
    tokenizer=replace(CPU.tokenizer, quantise=False, bits=16),
    # With the released settings, actions are hardly followed: their loss gives most weight to noise so small that the
    # frame shows through it.
    model=replace(
        CPU.model, diffusion=DiffusionConfig(channels=16, patch=1, width=48, depth=2, weight_cap=20.0, time_shift=4.0)
    ),
    eval=replace(CPU.eval, decode=DecodeConfig(sampler=SamplerConfig(kind="dpm++", steps=12, temperature=0.0))),
)

CPU_FULL_CONTINUOUS = replace(
    CPU_FULL,
    name="cpu-full-continuous",  # do latents do as well, with what the ladder found? three seeds, a control
    tokenizer=CPU_CONTINUOUS.tokenizer,
    model=replace(CPU_CONTINUOUS.model, recall=True),
    train=replace(CPU_FULL.train, steps=16_000, optimizer=replace(CPU_FULL.train.optimizer, matrices="muon")),
    eval=CPU_CONTINUOUS.eval,
    designs=replace(CPU_FULL.designs, budgets=(), long=()),
    axes=("horizon",),
)

PLAY = replace(
    CPU,
    name="play",  # eight robots to drive, 64 pixels, two cores, hours
    suite=SuiteConfig(scale=3.0),
    datasets=(
        "pusher_sand",
        "rover_road",
        "arm_chalk",
        "gripper_wood",
        "picker_slate",
        "omni_chalk",
        "arm_sand",
        "gripper_night",
    ),
    # The same number of tokens per frame as at 32 pixels, of 24 bits each.
    tokenizer=TokenizerConfig(image_size=64, downsample=8, bits=24, factors=6, channels=128),
    tokenizer_train=TokenizerTrainConfig(steps=3000, batch=32),
    rate=None,  # 4 to 6 Hz: half as much motion between frames as at 2 Hz
    model=replace(CPU.model, width=64, layers=3, heads=4, factors=6, recall=True, mup=MupConfig(base_width=48)),
    train=replace(
        CPU.train,
        steps=16_000,
        ema_decay=0.999,
        masking=replace(CPU.train.masking, teacher_forcing=True, change_weight=3.0),
        optimizer=replace(CPU.train.optimizer, warmup_steps=100, decay_fraction=0.25, matrices="muon"),
    ),
    dataset_counts=(8,),
    widths=(64,),
    transfer=TransferConfig(widths=(32, 48, 64), datasets=8, steps=1200),
)

PLAY_GPU = replace(
    PLAY,
    name="play-gpu",  # the model of `make play`: the same robots, more of their data, a larger trunk, minutes of a GPU
    suite=SuiteConfig(scale=8.0),
    model=replace(PLAY.model, width=128, layers=4),
    train=replace(PLAY.train, steps=8000, batch=32),
    widths=(128,),
    transfer=TransferConfig(widths=(48, 64, 128), datasets=8, steps=1200),
    flops_per_second=2e13,
)

PRESETS = {
    p.name: p
    for p in (
        SMOKE, CPU, CPU_FULL, ACCELERATOR, PAPER, SMOKE_CONTINUOUS, CPU_CONTINUOUS, CPU_FULL_CONTINUOUS, PLAY,
        PLAY_GPU,
    )
}  # fmt: skip


ON_ACCELERATORS = {"smoke": "accelerator", "cpu": "accelerator", "cpu-full": "accelerator", "play": "play-gpu"}
"""The preset to use on a GPU or TPU in place of one that is made for CPUs."""


def get_preset(name: str) -> Study:
    """The preset of this name. Raises ConfigError, listing the names, if there is none."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; known: {', '.join(PRESETS)}")
    return PRESETS[name]
