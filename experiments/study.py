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

from data_pipelines.sampling.splits import MAX_VAL, MAX_VAL_FRACTION, MIN_VAL, VAL_FRACTION, check_bounds
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


@dataclass(frozen=True)
class SuiteConfig:
    """The simulated datasets; not used when a study runs on the user's own."""

    scale: float = 1.0  # multiplies the largest dataset's number of episodes
    fewest: int = 8  # episodes of the smallest dataset; what lies between is stretched evenly in the logarithm
    seed: int = 0  # of episodes and appearances
    validation: int = 24  # held-out episodes of every dataset

    def __post_init__(self):
        require(0 < self.scale < math.inf, f"suite.scale must be positive and finite, got {self.scale:g}")
        require(self.fewest >= 1, f"suite.fewest must be at least 1 episode, got {self.fewest}")


@dataclass(frozen=True)
class StoreConfig:
    """What the token store keeps (`data_pipelines.tokens.tokenize_job`)."""

    val_fraction: float = VAL_FRACTION  # of episodes that are held out
    min_val: int = MIN_VAL  # held-out episodes per dataset, at least
    max_val: int = MAX_VAL  # and at most
    max_val_fraction: float = MAX_VAL_FRACTION  # of a dataset, at most, whatever min_val says
    frame_step: int | None = None  # None: only the frames of the study's rate; 1: those of any rate
    corrupt: Literal["raise", "skip"] = "raise"  # damaged records: stop, or leave out and count
    max_skipped: float = 16.0  # damaged episodes per dataset that may be left out; below 1: this share of them

    def __post_init__(self):
        m = self.max_skipped
        require(
            m >= 0 and (m < 1 or float(m).is_integer()),
            f"store.max_skipped must be a whole number of episodes or, below 1, a share of them, got {m:g}",
        )
        # As tokenising asks for them, which may come hours later.
        check_bounds(self.val_fraction, self.min_val, self.max_val, self.max_val_fraction, "store.")
        require(
            self.frame_step is None or self.frame_step >= 1,
            f"store.frame_step must be at least 1, got {self.frame_step}",
        )


@dataclass(frozen=True)
class TransferConfig:
    """The grid of the learning-rate sweep (`transfer_lr`), on a smaller trial if so declared."""

    rates: int = 5  # per width; an odd number, so that one is in the middle
    factor: float = 2.0  # between one rate and the next
    shift: int = 0  # how many rates the middle is above the study's own
    widths: tuple[int, ...] = ()  # (): those of the study
    datasets: int | None = None  # only the first so many; None: all
    steps: int | None = None  # None: as many as every other trial

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
    """Designs of a study that is to be believed (axes `dilution`, `transfer`, `newcomers`, `fewshot`, `episodes`,
    `compute`, `horizon`, `lr_horizon`); the demonstration has none of them. Fields of steps name decay branches of
    runs that trials share (`experiments.running.shared_runs`)."""

    judged: int = 5  # robots drawn at random, others for every seed, on whom designs over robots judge
    counts: tuple[int, ...] = (5, 10, 20, 40)  # robots in the mixture
    poor: int = 8  # trajectories of the judged robots, where they are to be poor
    kinship: int = 20  # robots in the mixture where newcomers are siblings or strangers
    shots: tuple[int, ...] = (4, 16, 64)  # trajectories of each unseen robot
    shots_after: tuple[int, ...] = (5, 20, 40)  # robots that the model knows by then
    shots_steps: int = 1000  # of adapting
    caps: tuple[int, ...] = (4, 16, 64, 256)  # trajectories per robot at most; the last point has all
    budgets: tuple[int, ...] = (1000, 2000, 4000, 8000)  # steps of the reference; those of `train` are added
    long: tuple[int, ...] = ()  # more steps of the reference, of the first seed alone
    compute: tuple[int, ...] = (500, 1000, 2000, 4000)  # steps of the reference whose FLOPs every width may use
    rate_factors: tuple[float, ...] = (0.5, 1.0, 2.0)  # of the learning rate, at fewest steps and at those of `train`
    ablation_steps: int | None = None  # of `settings` and `conditioning`; None: as many as every other trial
    end_controls: bool = False  # controls at both ends of an axis, not at the reference alone
    # Other episodes' actions that all are judged under but the reference, at any steps, and its control; None: as many
    # as `eval` says.
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

    name: str  # that of the preset, shown in titles
    model: ModelConfig
    train: TrainConfig
    eval: EvalConfig
    dataset_counts: tuple[int, ...]  # the first of them is of the robots that the axis is judged on
    trajectory_counts: tuple[int, ...]  # per dataset
    widths: tuple[int, ...]  # of the width axis, which has the reference trial's as well
    tokenizer: AnyTokenizerConfig = field(default_factory=TokenizerConfig)
    tokenizer_train: TokenizerTrainConfig = field(default_factory=TokenizerTrainConfig)
    suite: SuiteConfig = field(default_factory=SuiteConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    datasets: tuple[str, ...] = ()  # in the order they are added; () takes the suite's own order
    tau: float = 3.0  # temperature of the mixture
    # Hz at which frames are seen: 2 in the paper's pre-training; null, the native rate, in its post-training. An
    # entry of the registry may have its own.
    rate: float | None = 2.0
    # Whose windows weigh in the mixture: those of the trajectories that are used, as in the release's sampler, or
    # all, so that on the trajectories axis nothing but the trajectories changes.
    weighed: Literal["used", "all"] = "used"
    seeds: tuple[int, ...] = (0,)  # of initial values, order of data and subsets of trajectories together
    ablation_seeds: tuple[int, ...] = (0, 1, 2)  # of the ablations, whose error bars are over seeds
    transfer: TransferConfig = field(default_factory=TransferConfig)
    designs: DesignConfig = field(default_factory=DesignConfig)
    axes: tuple[str, ...] = ("datasets", "trajectories", "width")  # what `hma study` runs
    judged: Literal["first", "drawn"] = "first"  # on the datasets axis: the first datasets, or random ones per seed
    unseen: tuple[str, ...] = ()  # robots that no model is trained on but to adapt to them
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)  # how trials are computed; names none
    flops_per_second: float = 1e13  # sustained, of one device; as the next only for the estimates of --dry-run
    trial_seconds: float = 120.0  # of a trial, besides computing: start, compilation, decoding, files

    def __post_init__(self):
        for axis in ("dataset_counts", "trajectory_counts", "widths", "seeds", "ablation_seeds"):
            points = getattr(self, axis)
            require(len(points) >= 1, f"{axis} is empty; give at least one point")
            require_increasing(axis, points, at_least=0 if "seeds" in axis else 1)
        for seed in (*self.seeds, *self.ablation_seeds):
            require_seed(seed, "a seed of seeds and ablation_seeds")
        self._check_tokens()
        # As training asks for them, which comes after data and tokenizer were made.
        check_objective(self.model, self.train.masking)
        check_micro_batches(self.train.batch, self.execution.accumulate)
        check_decoding(self.model, self.eval.decode)  # as the evaluation would, which comes after training
        self.eval.check_images(self.tokenizer.image_shape)
        require(not self.train.seed, f"train.seed: a trial has one of seeds; set seeds={self.train.seed}")
        for name in ("tau", "flops_per_second"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name):g}")
        require(self.trial_seconds >= 0, f"trial_seconds must not be negative, got {self.trial_seconds:g}")
        require(
            self.rate is None or self.rate > 0,
            f"rate, in frames per second, must be positive, or null for the native rate, got {self.rate}",
        )
        require(
            self.eval.prompt_frames < self.model.frames,
            f"eval.prompt_frames {self.eval.prompt_frames} leaves nothing to predict in a window of "
            f"model.frames {self.model.frames}",
        )
        require(len(set(self.datasets)) == len(self.datasets), f"datasets repeat: {self.datasets}")
        known = sorted(set(self.unseen) & set(self.datasets))
        require(not known, f"unseen robots are trained on: {', '.join(known)}; leave them out of datasets")

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
    """The same study on the user's datasets: counts beyond what there is are cut to it."""
    counts = tuple(sorted({min(c, len(names)) for c in study.dataset_counts} | {len(names)}))
    return replace(study, datasets=tuple(names), dataset_counts=counts, unseen=())


def on_tokenizer(study: Study, tokenizer: AnyTokenizerConfig) -> Study:
    """The same study on the tokens of a given tokenizer: what the model takes follows from it.

    Raises ConfigError when one of the two is made for ids and the other for latents.
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
    elif study.model.diffusion.token_channels == tokenizer.token_channels:
        sizes = {}
    else:
        patch = tokenizer.patch if isinstance(tokenizer, Latents) else 1
        cells = tokenizer.token_channels // patch**2
        sizes = {"diffusion": replace(study.model.diffusion, channels=cells, patch=patch)}
    model = replace(study.model, tokens=tokenizer.tokens, **sizes)
    return replace(study, tokenizer=tokenizer, model=model)
