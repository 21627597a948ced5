"""Behaviour cloning: a small network that does what the demonstrations did, by least squares.

From imprecise actions it learns their mean, which is precise. It sees the last `frames` images and gives a chunk of
`chunk` actions, of which `execute` are executed before it looks again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.applications.policies.acting import ChunkConfig, ChunkPolicy, frames_of, make_examples, scale_of
from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.learning import FitConfig, Report, fit
from experiments.applications.policies.network import (
    EncoderConfig,
    Params,
    as_floats,
    encode,
    init_encoder,
    init_mlp,
    jitter_colour,
    mlp,
    stack_frames,
)
from hma_jax.kernels.random import key_of


@dataclass(frozen=True)
class BcConfig(ChunkConfig):
    """A policy and its training."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    light: float = 0.03  # standard deviation of the change in light of a training example, in [-1, 1]


def init_bc(config: BcConfig, action_dim: int, seed: int) -> Params:
    """float32 parameters that have learnt nothing."""
    first, second = jax.random.split(key_of(seed))
    hidden = config.encoder.hidden
    return {
        "encoder": init_encoder(first, config.encoder, 3 * config.frames),
        "mlp": init_mlp(second, (config.encoder.features, hidden, hidden, config.chunk * action_dim)),
    }


def apply_bc(params: Params, config: BcConfig, frames: jax.Array) -> jax.Array:
    """Normalised actions [B, chunk * A] after frames [B, frames, H, W, 3] in [-1, 1]."""
    return mlp(params["mlp"], encode(params["encoder"], config.encoder, stack_frames(frames)))


def train_bc(demos: Demonstrations, config: BcConfig, seed: int, report: Report) -> dict[int, ClonedPolicy]:
    """{step: policy} for `config.fit.keep` and the last step: from hardly trained to fully trained.

    A pure function of its arguments; takes minutes on one core.
    """
    data = make_examples(demos, config.frames, config.chunk, config.encoder.size)

    def loss(params: Params, data, index: jax.Array, key: jax.Array) -> jax.Array:
        planned = apply_bc(params, config, jitter_colour(frames_of(data, index), key, config.light))
        return jnp.mean((planned - data["chunk"][index]) ** 2)

    start = init_bc(config, demos.actions.shape[-1], seed)
    kept, scale = fit(start, loss, data, len(data["episode"]), config.fit, seed, report), scale_of(demos)
    return {step: ClonedPolicy(config, params, scale) for step, params in kept.items()}


@partial(jax.jit, static_argnums=1)
def _act(params: Params, config: BcConfig, images: jax.Array) -> jax.Array:
    """Compiled once for all checkpoints of a policy."""
    return apply_bc(params, config, as_floats(images))


class ClonedPolicy(ChunkPolicy):
    """A policy that acts by a network trained by `train_bc`."""

    kind = "cloned"

    def plan(self, frames: np.ndarray, seeds: Sequence[int], steps: Sequence[int]) -> np.ndarray:
        return np.asarray(_act(self.params, self.config, frames))


def clone(demos: Demonstrations, config: BcConfig, seed: int, report: Report) -> ClonedPolicy:
    """The policy after all of its training."""
    return train_bc(demos, config, seed, report)[config.fit.steps]
