"""The cost of what is made before the first trial of a study: simulating, the tokenizer, tokens, and starting up.

Computed by formula and from measurements on two cores of the machine for which the `cpu` preset is meant; nothing is
made and no data is read. A dataset is not counted, but named, if neither its files nor the registry say how many frames
it has.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from data_pipelines.registry import get_spec
from experiments.data_size import size_of
from experiments.preparing.tokenizer import QUALITY_FRAMES
from experiments.study import Study
from experiments.terminal.words import duration, few
from hma_jax.config import AnyTokenizerConfig, TokenizerConfig

SIMULATED = 3000.0
"""Native frames of the suite that two cores simulate, draw and write per second."""
DECODED = 1500.0
"""Frames that a core reads, decodes at full size and resizes per second, for training a tokenizer or for encoding.
Several cores share this work (`decoding_threads`), but the planning machine need not be the one that does it."""
LARGE_PRODUCTS = 3.0
"""How many times as many FLOPs per second a tokenizer reaches as a small world model: its products are larger, and it
has all cores."""
START = 30.0
"""Seconds that the whole preparation spends importing and compiling."""


@dataclass(frozen=True)
class PreparingCost:
    """In seconds."""

    simulating: float = 0.0
    tokenizer: float = 0.0
    tokens: float = 0.0
    unknown: tuple[str, ...] = ()  # datasets whose number of frames is unknown
    datasets: int = 0  # including these

    @property
    def seconds(self) -> float:
        making = self.simulating + self.tokenizer + self.tokens
        return START + making if making else 0.0


@dataclass(frozen=True)
class Frames:
    native: float
    kept: float  # frames at the study's rate, in the episodes that are tokenised
    simulated: bool


def estimate_preparing(
    study: Study, simulated: bool = True, trained: bool = True, tokenised: bool = True
) -> PreparingCost:
    """`simulated`: the suite is made, no data is given. `trained`: the tokenizer is trained, none is given.
    `tokenised`: tokens are made, since they do not exist yet; if they exist, nothing else is made either."""
    if not tokenised:
        return PreparingCost()
    counts = {name: count_frames(study, name) for name in study.all_names()}
    known = [frames for frames in counts.values() if frames]
    kept = sum(frames.kept for frames in known)
    encode, step = (flops / LARGE_PRODUCTS for flops in tokenizer_flops(study.tokenizer))
    rate, train = study.flops_per_second, study.tokenizer_train
    training = train.steps * train.batch * (step / rate + 1 / DECODED)
    return PreparingCost(
        simulating=sum(frames.native for frames in known if frames.simulated) / SIMULATED if simulated else 0.0,
        tokenizer=training + QUALITY_FRAMES * step / 3 / rate if trained and step else 0.0,
        tokens=kept * (encode / rate + 1 / DECODED),
        unknown=tuple(name for name, frames in counts.items() if frames is None),
        datasets=len(counts),
    )


def count_frames(study: Study, name: str) -> Frames | None:
    """Number of frames in the episodes of a dataset from which tokens are made, including held-out ones; None if
    unknown."""
    from data_pipelines.suite.embodiments import EMBODIMENTS
    from data_pipelines.suite.generate import episode_count

    spec = get_spec(name)
    robot = next((e for e in EMBODIMENTS if e.name == name), None)
    if robot is not None:
        low, high = robot.seconds
        seconds = (high - low) / math.log(high / low) if high > low else low  # lengths are uniform in the logarithm
        train = episode_count(robot, study.suite.scale, study.suite.fewest)
        made = train + study.suite.validation
        count = sum(study.store.held_out.used(train, study.suite.validation, bool(spec.val_split)))
        native = made * seconds * robot.hz
    else:
        size = size_of(spec, study.store.held_out)
        made = count = size.tokenised
        native = count * (size.mean_steps or spec.mean_steps or spec.median_steps)
        if not native:
            return None
    every = study.store.frame_step or spec.stride_at(study.rate)
    return Frames(native, native * (count / made) / every, robot is not None)


@functools.cache
def tokenizer_flops(config: AnyTokenizerConfig) -> tuple[float, float]:
    """FLOPs (to encode an image, to train on one) by counting matrix products; 0 for a tokenizer that is not declared
    here, whose time is then only that of reading frames."""
    import jax
    import jax.numpy as jnp

    from hma_jax.diagnostics.products import count_products, total_flops
    from hma_jax.tokenizers.autoencoder import declare_tokenizer
    from hma_jax.tokenizers.network import from_pixels
    from hma_jax.tokenizers.train import tokenizer_loss

    if not isinstance(config, TokenizerConfig):
        return 0.0, 0.0
    declared = declare_tokenizer(config)
    image = jax.ShapeDtypeStruct((1, config.image_size, config.image_size, 3), jnp.uint8)
    key = jax.eval_shape(lambda: jax.random.key(0))

    def encode(params, images):
        return declared.merge(params).encoder(from_pixels(images))

    def train(params, images, key):
        return jax.grad(lambda p: tokenizer_loss(declared, p, images, config, key)[0])(params)

    shapes = declared.shapes()
    return total_flops(count_products(encode, shapes, image)), total_flops(count_products(train, shapes, image, key))


def describe(cost: PreparingCost) -> str:
    """In words."""
    parts = {"simulating": cost.simulating, "the tokenizer": cost.tokenizer, "tokens": cost.tokens}
    text = ", ".join(f"{name} {duration(seconds)}" for name, seconds in parts.items() if seconds)
    if not cost.unknown:
        return text
    known = cost.datasets - len(cost.unknown)
    without = (
        f"unknown for {len(cost.unknown)} of {cost.datasets} datasets, because nothing says how many frames they have "
        f"({few(cost.unknown)})"
    )
    return f"{without}; {duration(cost.seconds)} with the other {known} alone ({text})" if known else without
