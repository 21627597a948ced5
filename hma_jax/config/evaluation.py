"""How frames are generated and judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from hma_jax.config.base import check_fields, later, require, require_seed
from hma_jax.config.model import ModelConfig

SamplerKind = Literal["ddpm", "ddim", "dpm++"]

SMALLEST_LPIPS_IMAGE = 31
"""Side, in pixels, of the smallest image for which the last layers of LPIPS's network still have one position."""


@dataclass(frozen=True)
class SamplerConfig:
    """How clean vectors are drawn (`diffusion.sample`).

    `ddpm` is ancestral sampling, as released; `ddim` (eta 0), as the paper states, draws nothing after the initial
    noise. `dpm++`, DPM-Solver++(2M) (Lu et al. 2022), needs the fewest steps to give samples the right spread.
    `temperature` multiplies the noise; at 0 only what the condition implies is left.
    """

    kind: SamplerKind = "ddpm"  # sampler of the diffusion heads
    steps: int = 100  # sampler steps (evaluations of the denoiser); 8 to 12 are enough for dpm++
    temperature: float = 1.0  # factor on the noise; 0: no noise
    # dpm++: how much new noise each step adds, from 0 (none) to 1 (as much as ancestral sampling). 0 suits
    # an exact network best; a trained one errs, and noise corrects it (docs/performance.md).
    eta: float = 0.5
    # Multiply the initial noise by the temperature too; false: only the noise of the steps, as released. DIFFERS: at
    # "temperature 0" the release's samples still depend on the random numbers they start from.
    scale_initial_noise: bool = True

    def __post_init__(self):
        check_fields(self)
        require(self.steps >= 2, f"sampler.steps must be at least 2, got {self.steps}")
        require(self.temperature >= 0, f"sampler.temperature must not be negative, got {self.temperature}")
        require(0.0 <= self.eta <= 1.0, f"sampler.eta must lie in [0, 1], got {self.eta}")
        require(
            self._stochastic or self.scale_initial_noise or self.temperature == 1,
            f"sampler.temperature has no effect on {self.kind} without scale_initial_noise; set "
            "scale_initial_noise=true or temperature=1",
        )

    @property
    def greedy(self) -> bool:
        """Whether nothing is random in what is drawn."""
        return self.temperature == 0 and self.scale_initial_noise

    @property
    def noisy_steps(self) -> bool:
        """Whether the steps after the first need random numbers."""
        return self._stochastic and self.temperature > 0

    @property
    def _stochastic(self) -> bool:
        return self.kind == "ddpm" or (self.kind == "dpm++" and self.eta > 0)


@dataclass(frozen=True)
class DecodeConfig:
    """How a masked frame is filled (`decoding`).

    `temperature` divides the logits of discrete tokens; 0 takes the most likely entry of each
    factor. DIFFERS: the release divides probabilities by it, which has no effect, since drawing renormalises them
    (reference section 3.2). Continuous tokens use the `sampler` and its temperature, which is the same unless a sampler
    is given; `sampler` is never None once this exists.
    """

    unmask_steps: int = 2  # M: unmasking steps per frame
    temperature: float = 0.0  # sampling temperature of ids; 0: the most likely ones
    top_k: int = 0  # sample only from the k most likely entries of each factor; 0: from all
    order: Literal["random", "confidence"] = "random"  # order in which tokens are unmasked
    sampler: SamplerConfig | None = None  # what draws latents; null: ddpm in 100 steps, at the temperature above
    resample: bool = False  # models on latents: predict every patch again in each unmasking step, as released
    # How to continue after the window of T frames: `exact` computes the window again for every frame;
    # `streaming` reuses keys and values from when the frames had other positions, an approximation.
    slide: Literal["exact", "streaming"] = "exact"

    def __post_init__(self):
        check_fields(self)
        require(self.unmask_steps >= 1, f"decode.unmask_steps must be at least 1, got {self.unmask_steps}")
        require(self.temperature >= 0, f"decode.temperature must not be negative, got {self.temperature}")
        require(self.top_k >= 0, f"decode.top_k must not be negative, got {self.top_k}")
        if self.sampler is None:
            object.__setattr__(self, "sampler", SamplerConfig(temperature=self.temperature))

    @property
    def greedy(self) -> bool:
        """Whether ids are the most likely ones. The order in which they are unmasked is random all the same."""
        return self.temperature == 0


@dataclass(frozen=True)
class EvalConfig:
    """The evaluation protocol (paper section 4, Metrics)."""

    windows_per_dataset: int = 500  # largest number of held-out windows per dataset that are evaluated
    # The frames before a predicted frame: after the prompt, frames that the model generated; or (`recorded`, as in the
    # release's evaluation) always the recorded ones.
    context: Literal["generated", "recorded"] = "generated"
    prompt_frames: int = 4  # recorded frames at the beginning of a window
    decode: DecodeConfig = field(default_factory=DecodeConfig)
    random_actions: int = 5  # random action sequences for delta PSNR
    # Action sequences of other episodes that the true actions are compared with; 0: no action-nats and no retrieval.
    other_actions: int = 15
    batch: int = 32  # windows per batch
    # Perplexity is exp(mean loss) of groups of this many windows, as in the official evaluation.
    perplexity_group: int = 4
    # Compute LPIPS too (AlexNet; its weights are the extra `lpips`); needs images of at least 31 x 31 pixels.
    lpips: bool = later(False)
    seed: int = 0  # random seed of the choice of windows and of all samples

    def __post_init__(self):
        check_fields(self)
        require(self.windows_per_dataset >= 1, "eval.windows_per_dataset must be at least 1")
        require(self.prompt_frames >= 1, "eval.prompt_frames must be at least 1")
        require(self.random_actions >= 1, "eval.random_actions must be at least 1")
        require(self.other_actions >= 0, "eval.other_actions must not be negative")
        require(self.batch >= 1, f"eval.batch must be at least 1, got {self.batch}")
        require_seed(self.seed, "eval.seed")
        require(self.perplexity_group >= 1, f"eval.perplexity_group must be at least 1, got {self.perplexity_group}")

    @property
    def first_predicted(self) -> int:
        """The first frame of a window that is compared with the recorded one."""
        return self.prompt_frames if self.context == "generated" else 1

    def check_images(self, shape: tuple[int, int]) -> None:
        """Raises ConfigError for images of `shape` (height, width) that cannot be judged as asked."""
        require(
            not self.lpips or min(shape) >= SMALLEST_LPIPS_IMAGE,
            f"eval.lpips needs images of at least {SMALLEST_LPIPS_IMAGE} x {SMALLEST_LPIPS_IMAGE} pixels, the tokenizer "
            f"makes {shape[0]} x {shape[1]}",
        )


def check_decoding(model: ModelConfig, decode: DecodeConfig) -> None:
    """Raises ConfigError for a way of filling frames that does not exist for the tokens of `model`."""
    if model.diffusion is None:
        require(
            decode.top_k <= model.factor_vocab,
            f"decode.top_k {decode.top_k} exceeds the {model.factor_vocab} entries of a factor",
        )
        require(not decode.resample, "decode.resample works only for models on latents; set it to false")
        return
    require(
        decode.order == "random",
        "decode.order 'confidence' needs probabilities, which models on latents do not predict; use 'random'",
    )
    require(decode.top_k == 0, "decode.top_k works only for models on ids: latents have no vocabulary; set it to 0")
    require(
        decode.temperature == 0 or decode.sampler.temperature > 0,
        f"decode.temperature {decode.temperature} is that of ids, and latents are drawn at decode.sampler.temperature, "
        "which is 0; set that one",
    )
    steps, most = decode.sampler.steps, model.diffusion.steps
    require(
        steps <= most,
        f"decode.sampler.steps {steps} is more than model.diffusion.steps {most}, the steps of the noising process; "
        "change one of the two (of a simulator: sampler.steps in the run's decode.json)",
    )
