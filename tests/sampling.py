"""Sampling from recorded noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import SamplerConfig
from hma_jax.objective.diffusion import Network, run_sampler, sampler_step
from hma_jax.objective.process import Process


class Trajectory(NamedTuple):
    """Every step of a run, noisiest first."""

    x: jax.Array  # [steps, ..., C], after the step
    x0: jax.Array  # [steps, ..., C], the clean vectors predicted in the step


def _noise_at(noise_steps: jax.Array | None) -> Callable[[jax.Array], jax.Array]:
    recorded = jnp.asarray([] if noise_steps is None else noise_steps, jnp.float32)
    return lambda index: recorded[-1 - index]


def sample_recorded(
    network: Network,
    noise_init: jax.Array,
    noise_steps: jax.Array | None,
    process: Process,
    sampler: SamplerConfig,
    clip: float,
) -> jax.Array:
    """Clean vectors [..., C]. noise_init [..., C]; noise_steps [steps, ..., C], first the noisiest step's (the last
    step adds none), or None where `sampler.noisy_steps` is false."""
    return run_sampler(network, noise_init, _noise_at(noise_steps), process, sampler, clip)


def trajectory_of(
    network: Network,
    noise_init: jax.Array,
    noise_steps: jax.Array | None,
    process: Process,
    sampler: SamplerConfig,
    clip: float,
) -> Trajectory:
    """The steps of `sample_recorded`."""
    step = sampler_step(network, _noise_at(noise_steps), process, sampler, clip)
    x = jnp.asarray(noise_init, jnp.float32) * (sampler.temperature if sampler.scale_initial_noise else 1.0)
    indices = jnp.arange(process.steps - 1, -1, -1)

    def visit(carry: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[tuple[jax.Array, jax.Array], Trajectory]:
        carry = step(carry, index)
        return carry, Trajectory(*carry)

    return jax.lax.scan(visit, (x, jnp.zeros_like(x)), indices)[1]
