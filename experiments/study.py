"""What a study fixes: data, tokenizer, base model, budget, protocol and the points of each axis.

Owns the `Study` record and how it follows the user's data and tokenizer. Single settings are changed by `override`;
named instances are in `presets`; which trials follow from a study is in `sweeps`, a file for each axis. Nothing here
imports JAX.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from data_pipelines.registry import find_spec
from data_pipelines.sampling.splits import HeldOut
from experiments.data_size import size_by_entry, size_of
from hma_jax.config import (
    AnyTokenizerConfig,
    EvalConfig,
    ExecutionConfig,
    Latents,
    ModelConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
    TrainConfig,
    check_decoding,
    check_micro_batches,
    check_objective,
    require,
)
from hma_jax.config.base import require_seed

SCALING = ("datasets", "trajectories", "width")
"""The demonstration: the axes that `hma study` runs, unless its preset says otherwise."""

PROCESSOR = 1e12
"""FLOP/s that no CPU sustains: a study with at least this many per device is for accelerators."""


@dataclass(frozen=True)
class SuiteConfig:
    """The simulated datasets; not used when a study runs on the user's own."""

    scale: float = 1.0  # factor on the number of episodes of the largest dataset
    # Episodes of the smallest dataset; the sizes of the others are interpolated in the logarithm.
    fewest: int = 8
    seed: int = 0  # random seed of episodes and appearances
    validation: int = 24  # held-out episodes of every dataset

    def __post_init__(self):
        require(0 < self.scale < math.inf, f"suite.scale must be positive and finite, got {self.scale:g}")
        require(self.fewest >= 1, f"suite.fewest must be at least 1 episode, got {self.fewest}")


@dataclass(frozen=True)
class StoreConfig(HeldOut):
    """What the token store keeps (`data_pipelines.tokens.tokenize_job`)."""

    frame_step: int | None = None  # store every N-th native frame; 1: all; null: those of the study's rate
    corrupt: Literal["raise", "skip"] = "raise"  # at a damaged record, stop with an error, or leave it out and count it
    max_skipped: float = 16.0  # largest number of damaged episodes per dataset to leave out; below 1: a fraction

    def __post_init__(self):
        m = self.max_skipped
        require(
            m >= 0 and (m < 1 or float(m).is_integer()),
            f"store.max_skipped must be a whole number of episodes or, below 1, a fraction of them, got {m:g}",
        )
        # Checked here as tokenising checks them, which may come hours later.
        self.check("store.")
        require(
            self.frame_step is None or self.frame_step >= 1,
            f"store.frame_step must be at least 1, got {self.frame_step}",
        )


@dataclass(frozen=True)
class TransferConfig:
    """The grid of the axis `lr`, which asks whether the best learning rate transfers across widths, on a smaller trial
    if so declared. The axis `transfer` (from robots to others) is set by `DesignConfig`."""

    rates: int = 5  # number of learning rates per width; odd, so that one is in the middle
    factor: float = 2.0  # ratio of neighbouring learning rates
    shift: int = 0  # move the grid up by this many rates; 0: the study's own rate is in the middle
    widths: tuple[int, ...] = ()  # widths of the sweep; []: those of the study
    datasets: int | None = None  # train on the first N datasets only; null: all
    steps: int | None = None  # training steps; null: those of the study

    def __post_init__(self):
        require(
            self.rates >= 3 and self.rates % 2 == 1,
            f"transfer.rates must be odd and at least 3, got {self.rates}",
        )
        require(self.factor > 1, f"transfer.factor must be larger than 1, got {self.factor}")
        require_increasing("transfer.widths", self.widths, at_least=1)
        for name in ("datasets", "steps"):
            value = getattr(self, name)
            require(value is None or value >= 1, f"transfer.{name} must be at least 1, got {value}")


@dataclass(frozen=True)
class DesignConfig:
    """Designs of a study that is meant as evidence (axes `dilution`, `transfer`, `newcomers`, `fewshot`, `episodes`,
    `compute`, `horizon`, `lr_horizon`); the demonstration has none of them. Fields that give numbers of steps name
    decay branches of runs that trials share (`experiments.running.shared_runs`)."""

    # dilution, transfer, newcomers: number of judged robots (those that are evaluated), drawn at random for every seed.
    judged: int = 5
    counts: tuple[int, ...] = (5, 10, 20, 40)  # dilution, transfer: numbers of robots in the mixture
    poor: int = 8  # newcomers: trajectories of each judged robot
    kinship: int = 20  # newcomers: robots in the mixture where the newcomers are siblings, or strangers
    shots: tuple[int, ...] = (4, 16, 64)  # fewshot: numbers of trajectories of each unseen robot
    shots_after: tuple[int, ...] = (5, 20, 40)  # fewshot: numbers of robots that the model was trained on before
    shots_steps: int = 1000  # fewshot: steps in which the unseen robots are added
    # episodes: largest numbers of trajectories per robot; one more point has all.
    caps: tuple[int, ...] = (4, 16, 64, 256)
    # horizon: numbers of steps of the reference trial; train.steps is added. The first is the short one of lr_horizon.
    budgets: tuple[int, ...] = (1000, 2000, 4000, 8000)
    long: tuple[int, ...] = ()  # horizon, ladder: further numbers of steps, for the first seed only
    compute: tuple[int, ...] = (500, 1000, 2000, 4000)  # compute: budgets, as steps of the reference trial
    # lr_horizon: factors on the learning rate, at the smallest number of steps and at train.steps.
    rate_factors: tuple[float, ...] = (0.5, 1.0, 2.0)
    ablation_steps: int | None = None  # settings, conditioning, ladder: training steps; null: train.steps
    end_controls: bool = False  # train controls at both ends of an axis, not only at the reference trial
    # Replaces eval.other_actions for all trials but the reference trial, at any number of steps, and its control; null:
    # eval.other_actions for all.
    other_actions: int | None = None

    def __post_init__(self):
        for name in ("counts", "shots", "shots_after", "caps", "budgets", "long", "compute"):
            require_increasing(f"designs.{name}", getattr(self, name), at_least=1)
        factors = self.rate_factors
        require(
            list(factors) == sorted(set(factors)) and all(f > 0 for f in factors),
            f"designs.rate_factors must increase and be positive, got {factors}",
        )
        for name in ("judged", "poor", "kinship", "shots_steps"):
            require(getattr(self, name) >= 1, f"designs.{name} must be at least 1, got {getattr(self, name)}")
        n = self.other_actions
        require(n is None or n >= 0, f"designs.other_actions must not be negative, got {n}")


def require_increasing(name: str, points: tuple[int, ...], at_least: int) -> None:
    """Raises ConfigError unless `points` increase from `at_least`."""
    require(
        list(points) == sorted(set(points)) and all(p >= at_least for p in points),
        f"{name} must increase and be at least {at_least}, got {points}",
    )


@dataclass(frozen=True)
class Study:
    """One scaling study. The reference trial, which most axes share, uses all datasets, the
    largest trajectory count and the base model."""

    name: str  # name of the preset, shown in titles
    model: ModelConfig
    train: TrainConfig
    eval: EvalConfig
    dataset_counts: tuple[int, ...]  # axis datasets: numbers of datasets; all are evaluated on those of the first
    trajectory_counts: tuple[int, ...]  # axis trajectories: largest numbers of trajectories per dataset
    widths: tuple[int, ...]  # axis width: widths; that of the reference trial is added
    tokenizer: AnyTokenizerConfig = field(default_factory=TokenizerConfig)
    tokenizer_train: TokenizerTrainConfig = field(default_factory=TokenizerTrainConfig)
    suite: SuiteConfig = field(default_factory=SuiteConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    datasets: tuple[str, ...] = ()  # datasets, in the order in which the axis datasets adds them; []: the suite's
    tau: float = 3.0  # temperature of the mixture: a dataset with n windows has weight n^(1/tau)
    # Frames per second of the model: 2 in the paper's pre-training; null, the native rate, in its post-training. An
    # entry of the registry may have its own.
    rate: float | None = 2.0
    # Which windows give the weights of the mixture: those of the trajectories that are used, as in the release, or
    # all, so that on the axis trajectories the weights stay the same.
    weighed: Literal["used", "all"] = "used"
    seeds: tuple[int, ...] = (0,)  # random seeds of trials: of initial values, order of data and choice of trajectories
    ablation_seeds: tuple[int, ...] = (0, 1, 2)  # random seeds of the ablations, whose error bars are over seeds
    transfer: TransferConfig = field(default_factory=TransferConfig)
    designs: DesignConfig = field(default_factory=DesignConfig)
    axes: tuple[str, ...] = SCALING  # sweeps that `hma study` runs
    # Axis datasets: evaluate on the first datasets, or on random ones for every seed.
    judged: Literal["first", "drawn"] = "first"
    unseen: tuple[str, ...] = ()  # axis fewshot: robots that no model is trained on before it is adapted to them
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)  # how trials are computed; names none
    flops_per_second: float = 1e13  # sustained FLOP/s of one device, for the estimates of --dry-run
    trial_seconds: float = 120.0  # --dry-run: seconds per trial for start, compilation, decoding, files

    def __post_init__(self):
        for axis in ("dataset_counts", "trajectory_counts", "widths", "seeds", "ablation_seeds"):
            points = getattr(self, axis)
            require(len(points) >= 1, f"{axis} is empty; give at least one point")
            require_increasing(axis, points, at_least=0 if "seeds" in axis else 1)
        for seed in (*self.seeds, *self.ablation_seeds):
            require_seed(seed, "a seed of seeds and ablation_seeds")
        self._check_tokens()
        # Checked here as training checks them, which comes after data and tokenizer were made.
        check_objective(self.model, self.train.masking)
        rows, columns = self.tokenizer.grid_shape
        require(
            not self.train.masking.displaced_past or rows == columns,
            f"train.masking.displaced_past needs square frames, but the tokenizer makes {rows} x {columns} tokens",
        )
        check_micro_batches(self.train.batch, self.execution.accumulate)
        check_decoding(self.model, self.eval.decode)  # as evaluation checks it, which comes after training
        self.eval.check_images(self.tokenizer.image_shape)
        require(
            not self.train.seed,
            f"train.seed cannot be set, because trials take their seeds from seeds; set seeds={self.train.seed}",
        )
        for name in ("tau", "flops_per_second"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name):g}")
        require(self.trial_seconds >= 0, f"trial_seconds must not be negative, got {self.trial_seconds:g}")
        require(
            self.rate is None or 0 < self.rate < math.inf,
            f"rate, in frames per second, must be positive and finite, or null for the native rate, got {self.rate}",
        )
        require(
            self.eval.prompt_frames < self.model.frames + (self.train.masking.setting == "policy"),
            f"eval.prompt_frames {self.eval.prompt_frames} leaves nothing to predict in a window of model.frames "
            f"{self.model.frames}; use fewer",
        )
        require(len(set(self.datasets)) == len(self.datasets), f"datasets repeat: {self.datasets}")
        known = sorted(set(self.unseen) & set(self.datasets))
        require(not known, f"unseen robots must not be trained on: remove {', '.join(known)} from datasets")

    def _check_tokens(self) -> None:
        """Raises ConfigError unless the model takes the tokens that the tokenizer makes."""
        tokenizer, diffusion, channels = self.tokenizer, self.model.diffusion, self.tokenizer.token_channels
        wanted = {"tokens": tokenizer.tokens}
        if not channels:
            wanted |= {"factors": tokenizer.factors, "factor_vocab": tokenizer.factor_vocab}
        for name, want in wanted.items():
            require(
                getattr(self.model, name) == want,
                f"model.{name} is {getattr(self.model, name)} but the tokenizer makes {want}; "
                f"set model.{name}={want} or change the tokenizer",
            )
        if not channels:
            require(
                diffusion is None,
                "model.diffusion is set, so the model takes latents, but the tokenizer makes ids; set "
                "tokenizer.quantise=false, or start from a preset without diffusion",
            )
            return
        require(
            diffusion is not None,
            "tokenizer.quantise is false, so tokens are latents, but the model takes ids; set "
            f'model.diffusion={{"channels": {channels}, "patch": 1}}, or tokenizer.quantise=true',
        )
        require(
            diffusion.token_channels == channels,
            f"model.diffusion has {diffusion.token_channels} values per token (patch^2 x channels) but the "
            f"tokenizer makes {channels}; set model.diffusion.patch=1 and "
            f"model.diffusion.channels={channels}, or tokenizer.bits={diffusion.token_channels}",
        )

    @property
    def for_accelerators(self) -> bool:
        """Whether its estimates are for devices that are faster than any CPU."""
        return self.flops_per_second >= PROCESSOR

    def dataset_names(self) -> tuple[str, ...]:
        """Every dataset of the study, in the order in which the datasets axis adds them."""
        if self.datasets:
            return self.datasets
        from data_pipelines.suite.embodiments import TRAINED

        count = self.dataset_counts[-1]
        require(
            count <= len(TRAINED),
            f"dataset_counts asks for {count} datasets; the suite has {len(TRAINED)} to train on",
        )
        return tuple(e.name for e in TRAINED[:count])

    def all_names(self) -> tuple[str, ...]:
        """Every dataset that is prepared: those of the study and the unseen robots'."""
        return self.dataset_names() + self.unseen


def on_user_data(study: Study, names: Sequence[str]) -> Study:
    """The same study on the user's datasets: larger numbers of datasets are reduced to the number that exists."""
    counts = tuple(sorted({min(c, len(names)) for c in study.dataset_counts} | {len(names)}))
    return replace(study, datasets=tuple(names), dataset_counts=counts, unseen=())


def without_equal_caps(study: Study, by_entries: bool = False) -> Study:
    """The same study without superfluous numbers of trajectories: of those that leave out no trajectory, only the last
    is kept, since with the others a trial would be trained on the same data. `by_entries`: as in
    `most_trajectories`."""
    *caps, last = study.trajectory_counts
    most = most_trajectories(study, by_entries) or last
    return replace(study, trajectory_counts=(*(cap for cap in caps if cap < most), last))


def most_trajectories(study: Study, by_entries: bool = False) -> int | None:
    """Training trajectories of the largest dataset. Those that were left out as damaged are counted, since no other
    takes their place in a subset; so are held-out ones, if their number is unknown. None if the size of any dataset is
    unknown. `by_entries`: as the registry alone says."""
    find_size = size_by_entry if by_entries else size_of
    specs = [find_spec(name) for name in study.dataset_names()]
    sizes = [spec and find_size(spec, study.store.held_out) for spec in specs]
    counts = [size.skipped + (size.trained or size.tokenised) if size else 0 for size in sizes]
    return max(counts) if all(counts) else None


def on_tokenizer(study: Study, tokenizer: AnyTokenizerConfig) -> Study:
    """The same study on the tokens of a given tokenizer: what the model takes follows from it.

    Raises ConfigError if one of the two is made for ids and the other for latents.
    """
    latents, wanted = tokenizer.token_channels > 0, study.model.diffusion is not None
    kinds = {True: "latents", False: "ids"}
    require(
        latents == wanted,
        f"the tokenizer makes {kinds[latents]}, the model of preset {study.name} takes {kinds[wanted]}; "
        f"start from a preset {'that ends' if latents else 'that does not end'} in -continuous",
    )
    if not latents:
        sizes = {"factors": tokenizer.factors, "factor_vocab": tokenizer.factor_vocab}
    else:
        patch = tokenizer.patch if isinstance(tokenizer, Latents) else 1
        cells = tokenizer.token_channels // patch**2
        sizes = {"diffusion": replace(study.model.diffusion, channels=cells, patch=patch)}
    model = replace(study.model, tokens=tokenizer.tokens, **sizes)
    return replace(study, tokenizer=tokenizer, model=model)
