"""A small Diffusion Policy: a chunk of actions is drawn by denoising, given the observed frames (Chi et al. 2023).

The encoder is that of `cloning`; the denoiser is a network on the whole chunk instead of a U-Net over its steps.
Training adds noise of one of `levels` strengths (squared-cosine schedule) and predicts that noise or the clean chunk;
acting takes `samples` steps of DDIM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from experiments.applications.policies.acting import ChunkConfig, ChunkPolicy, Scale, frames_of, make_examples, scale_of
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
from hma_jax.config import require
from hma_jax.config.base import later, require_choice
from hma_jax.kernels.random import key_of

EMBEDDED = 32
"""Values that a noise level is given as: sines and cosines."""

SPREAD = 3.0
"""Number of standard deviations of the demonstrated actions, for the limits of this name."""

Predicts = Literal["noise", "chunk"]
"""What the denoiser is trained to predict."""

Limits = Literal["range", "spread"]
"""Limits beyond which no action is denoised: the range of the demonstrated actions, or SPREAD. Beyond SPREAD is, for
example, the action of a gripper that is closed in few frames."""


@dataclass(frozen=True)
class DiffusionConfig(ChunkConfig):
    """A policy and its training."""

    chunk: int = 4
    execute: int = 2
    levels: int = 100
    samples: int = 10
    predicts: Predicts = later("noise")
    limits: Limits = later("range", before="spread")
    width: int = 256
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    light: float = 0.03

    def __post_init__(self):
        super().__post_init__()
        require(
            1 <= self.samples <= self.levels,
            f"the number of denoising steps must lie in 1..{self.levels}, the noise levels, got {self.samples}",
        )
        require_choice(self.predicts, get_args(Predicts), "predicts")
        require_choice(self.limits, get_args(Limits), "limits")


def init_diffusion(config: DiffusionConfig, action_dim: int, seed: int) -> Params:
    first, second = jax.random.split(key_of(seed))
    out, width = config.chunk * action_dim, config.width
    inputs = config.encoder.features + EMBEDDED + out
    return {
        "encoder": init_encoder(first, config.encoder, 3 * config.frames),
        "denoiser": init_mlp(second, (inputs, width, width, out)),
    }


def signal(levels: int) -> np.ndarray:
    """float32 [levels]: the share of variance that is signal, from nearly all to nearly none (squared cosine)."""
    at = (np.arange(levels + 1) / levels + 0.008) / 1.008
    kept = np.cos(at * np.pi / 2) ** 2
    return np.clip(kept[1:] / kept[0], 1e-4, 0.9999).astype(np.float32)


def bounds(config: DiffusionConfig, scale: Scale) -> np.ndarray:
    """float32 [2, chunk * A]: the least and the greatest normalised actions of a chunk."""
    ends = scale.normalise(np.array([scale.low, scale.high]))
    if config.limits == "spread":
        ends = np.broadcast_to(np.array([[-SPREAD], [SPREAD]], np.float32), ends.shape)
    return np.tile(ends, config.chunk)


def denoise(params: Params, seen: jax.Array, noised: jax.Array, level: jax.Array) -> jax.Array:
    """The noise in chunks [B, chunk * A] at levels [B], or the clean chunks, as the network was trained, given features
    of what is seen [B, 3 K]."""
    rate = jnp.exp(-jnp.log(1000.0) * jnp.arange(EMBEDDED // 2, dtype=jnp.float32) / (EMBEDDED // 2))
    angle = level[:, None] * rate
    return mlp(params["denoiser"], jnp.concatenate([seen, jnp.sin(angle), jnp.cos(angle), noised], -1))


def draw(
    params: Params, config: DiffusionConfig, frames: jax.Array, start: jax.Array, limits: np.ndarray | jax.Array
) -> jax.Array:
    """Normalised chunks [B, chunk * A] from Gaussian `start` of that shape, by DDIM without new noise; `limits` are
    the `bounds`."""
    kept = jnp.asarray(signal(config.levels))
    seen = encode(params["encoder"], config.encoder, stack_frames(frames))
    visited = np.linspace(config.levels - 1, 0, config.samples).round().astype(int)
    following = np.append(visited[1:], -1)

    def step(x: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        now, then = at
        found = denoise(params, seen, x, jnp.full(len(x), now, jnp.float32))
        if config.predicts == "noise":
            found = (x - jnp.sqrt(1 - kept[now]) * found) / jnp.sqrt(kept[now])
        clean = jnp.clip(found, limits[0], limits[1])
        noise = (x - jnp.sqrt(kept[now]) * clean) / jnp.sqrt(1 - kept[now])
        left = jnp.where(then < 0, 1.0, kept[then])
        return jnp.sqrt(left) * clean + jnp.sqrt(1 - left) * noise, None

    return jax.lax.scan(step, start, (jnp.asarray(visited), jnp.asarray(following)))[0]


def train_diffusion(
    demos: Demonstrations, config: DiffusionConfig, seed: int, report: Report
) -> dict[int, DiffusionPolicy]:
    """{step: policy} for `config.fit.keep` and the last step; a function of its arguments."""
    signal_shares, scale = jnp.asarray(signal(config.levels)), scale_of(demos)
    data = make_examples(demos, config.frames, config.chunk, config.encoder.size)
    least, greatest = bounds(config, scale)

    def loss(params: Params, data, index: jax.Array, key: jax.Array) -> jax.Array:
        light, level_key, noise_key = jax.random.split(key, 3)
        frames = jitter_colour(frames_of(data, index), light, config.light)
        seen = encode(params["encoder"], config.encoder, stack_frames(frames))
        chunk = jnp.clip(data["chunk"][index], least, greatest)
        level = jax.random.randint(level_key, (len(index),), 0, config.levels, jnp.int32)
        noise = jax.random.normal(noise_key, chunk.shape, jnp.float32)
        share = signal_shares[level][:, None]
        noised = jnp.sqrt(share) * chunk + jnp.sqrt(1 - share) * noise
        wanted = noise if config.predicts == "noise" else chunk
        return jnp.mean((denoise(params, seen, noised, level.astype(jnp.float32)) - wanted) ** 2)

    start = init_diffusion(config, demos.actions.shape[-1], seed)
    kept = fit(start, loss, data, len(data["episode"]), config.fit, seed, report)
    return {step: DiffusionPolicy(config, params, scale) for step, params in kept.items()}


@partial(jax.jit, static_argnums=1)
def _act(params: Params, config: DiffusionConfig, images: jax.Array, start: jax.Array, limits: jax.Array) -> jax.Array:
    """Compiled once for all checkpoints of a policy."""
    return draw(params, config, as_floats(images), start, limits)


class DiffusionPolicy(ChunkPolicy):
    """A policy that acts by a network trained by `train_diffusion`. What it draws is a function of the episode's seed
    and step."""

    kind = "diffusion"

    def plan(self, frames: np.ndarray, seeds: Sequence[int], steps: Sequence[int]) -> np.ndarray:
        size = self.config.chunk * len(self.scale.mean)
        start = [np.random.default_rng([s, n, 14]).standard_normal(size) for s, n in zip(seeds, steps, strict=True)]
        limits = bounds(self.config, self.scale)
        return np.asarray(_act(self.params, self.config, frames, np.asarray(start, np.float32), limits))
