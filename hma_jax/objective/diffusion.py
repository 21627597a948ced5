"""The mathematics of diffusion over continuous vectors: training terms and sampling, given a noising process.

Epsilon prediction and learned-range variance (reference sections 2.4 and 2.5). The denoising
network is an argument everywhere: network(x_t [..., C], t [...]) -> [..., 2 C], the predicted noise
and then the variance, where t is int32 and counts steps of the original process even when a respaced one is run. In
sampling, where all vectors are at the same step, the axes of t have size 1. The caller decides which tokens are noised,
at which t, and how their losses are weighted; it also holds the parameters. Computation is float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import SamplerConfig, require
from hma_jax.kernels.random import draw_flat, fold_in_each
from hma_jax.objective.process import Process, multistep

Network = Callable[[jax.Array, jax.Array], jax.Array]


# --- The network's outputs -------------------------------------------------------------------


def _at(table: np.ndarray, t: jax.Array) -> jax.Array:
    """table[t] in float32 with an axis for the channels: t [...] -> [..., 1]."""
    return jnp.asarray(table, jnp.float32)[t][..., None]


class Prediction(NamedTuple):
    eps: jax.Array  # [..., C]
    log_variance: jax.Array  # [..., C], of x_{t-1} given x_t


def _predict(network: Network, x_t: jax.Array, t: jax.Array, process: Process) -> Prediction:
    """Runs the network; its second half, nominally in [-1, 1], places the log-variance between
    the posterior's and log beta (reference appendix B.8)."""
    out = network(x_t, jnp.asarray(process.timestep_map, jnp.int32)[t]).astype(jnp.float32)
    eps, variance = jnp.split(out, 2, axis=-1)
    fraction = (variance + 1) / 2
    low, high = _at(process.posterior_log_variance_clipped, t), _at(process.log_betas, t)
    return Prediction(eps, fraction * high + (1 - fraction) * low)


# --- Training --------------------------------------------------------------------------------


def diffusion_loss(
    network: Network,
    x0: jax.Array,
    t: jax.Array,
    noise: jax.Array,
    process: Process,
    valid: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """The two loss terms of every row: (mse [...], vb [...]), each a mean over channels.

    mse is the squared error of the predicted noise. vb, in bits, is the row's term of the
    variational bound; only the variance learns from it. x0 and noise [..., C], t int [...]
    counts steps of `process`. `valid` (bool [..., C]) leaves padded channels out of the means;
    every row needs at least one channel.
    """
    x0, noise = jnp.asarray(x0, jnp.float32), jnp.asarray(noise, jnp.float32)
    keep, spread = np.sqrt(process.alphas_cumprod), np.sqrt(1.0 - process.alphas_cumprod)
    predicted = _predict(network, _at(keep, t) * x0 + _at(spread, t) * noise, t, process)
    mse = (noise - predicted.eps) ** 2

    # True minus predicted posterior mean. x_t cancels, and written like this no rounding remains.
    to_mean = process.posterior_x0 * process.clean_from_eps
    gap = _at(to_mean, t) * (jax.lax.stop_gradient(predicted.eps) - noise)
    kl = _gaussian_kl(gap, _at(process.posterior_log_variance_clipped, t), predicted.log_variance)
    # At t = 0 the posterior's mean is x0 itself, and the bound holds the likelihood of x0.
    nll = -_binned_log_likelihood(x0, gap, predicted.log_variance)
    vb = jnp.where(t[..., None] == 0, nll, kl) / math.log(2)
    return jnp.mean(mse, axis=-1, where=valid), jnp.mean(vb, axis=-1, where=valid)


def _gaussian_kl(gap: jax.Array, log_variance: jax.Array, model_log_variance: jax.Array) -> jax.Array:
    """KL, in nats, of a Gaussian from the model's, whose mean lies `gap` away."""
    ratio = log_variance - model_log_variance
    return 0.5 * (jnp.exp(ratio) - 1.0 - ratio + gap**2 * jnp.exp(-model_log_variance))


def _binned_log_likelihood(x: jax.Array, gap: jax.Array, log_variance: jax.Array) -> jax.Array:
    """Log-probability, in nats, of the bin x +- 1/255 under a Gaussian with mean x - gap.

    As released: the bins are those of 8-bit images, so those beyond +-0.999 are open-ended although latents go further;
    tanh approximates the error function.
    """

    def cdf(z: jax.Array) -> jax.Array:
        return 0.5 * (1.0 + jnp.tanh(math.sqrt(2 / math.pi) * (z + 0.044715 * z**3)))

    sharpness = jnp.exp(-0.5 * log_variance)
    upper, lower = cdf((gap + 1 / 255) * sharpness), cdf((gap - 1 / 255) * sharpness)
    upper = jnp.where(x > 0.999, 1.0, upper)
    lower = jnp.where(x < -0.999, 0.0, lower)
    return jnp.log(jnp.maximum(upper - lower, 1e-12))


# --- Sampling --------------------------------------------------------------------------------


def sample(
    network: Network,
    key: jax.Array,
    shape: tuple[int, ...],
    process: Process,
    sampler: SamplerConfig,
    clip: float,
) -> jax.Array:
    """Clean vectors of `shape` [..., C]. The noise of a step is drawn when the step is run.

    `key` is one key, or an array of keys along the first axes of `shape`, so that what is drawn
    for one example does not depend on its neighbours.
    """
    require(
        key.shape == shape[: key.ndim],
        f"keys of shape {key.shape} do not match the first axes of samples of shape {shape}",
    )

    def draw(index: jax.Array | int) -> jax.Array:
        keys = fold_in_each(key.reshape(-1), index).reshape(key.shape)
        return draw_flat(jax.random.normal, keys, shape[key.ndim :])

    return run_sampler(network, draw(process.steps), draw, process, sampler, clip)


def run_sampler(
    network: Network,
    noise_init: jax.Array,
    noise_at: Callable[[jax.Array], jax.Array],
    process: Process,
    sampler: SamplerConfig,
    clip: float,
) -> jax.Array:
    """Clean vectors [..., C] from noise_init [..., C], through every step of `process`, from its last index down to 0.

    `noise_at`: index -> the noise [..., C] of that step; it is called only where `sampler.noisy_steps`.
    """
    require(
        process.steps == sampler.steps,
        f"sampler.steps is {sampler.steps} but the process has {process.steps}; use sampling_process(process, sampler)",
    )
    step = sampler_step(network, noise_at, process, sampler, clip)
    x = jnp.asarray(noise_init, jnp.float32) * (sampler.temperature if sampler.scale_initial_noise else 1.0)
    start, indices = (x, jnp.zeros_like(x)), jnp.arange(process.steps - 1, -1, -1)
    (x, _), _ = jax.lax.scan(lambda carry, index: (step(carry, index), None), start, indices)
    return x


def sampler_step(
    network: Network,
    noise_at: Callable[[jax.Array], jax.Array],
    process: Process,
    sampler: SamplerConfig,
    clip: float,
) -> Callable[[tuple[jax.Array, jax.Array], jax.Array], tuple[jax.Array, jax.Array]]:
    """step((x, x0 of the step before), index) -> (x after the step, the clean vectors x0 predicted in it), [..., C]
    each. x0 is kept in +-clip."""
    solver = multistep(process, sampler.eta)

    def step(carry: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, before = carry
        # Every vector is at the same step, so what the network computes from the step alone is computed once.
        t = jnp.full((1,) * (x.ndim - 1), index)
        predicted = _predict(network, x, t, process)
        from_xt, from_eps = _at(process.clean_from_xt, index), _at(process.clean_from_eps, index)
        x0 = jnp.clip(from_xt * x - from_eps * predicted.eps, -clip, clip)
        if sampler.kind == "dpm++":
            ahead = x0 + _at(solver.lead, index) * (x0 - before)
            x = _at(solver.keep, index) * x + _at(solver.mix, index) * ahead
            if sampler.noisy_steps:
                x += sampler.temperature * _at(solver.fresh, index) * noise_at(index)
        elif sampler.kind == "ddim":
            eps = (from_xt * x - x0) / from_eps  # the noise that agrees with the clipped x0
            cleaner = process.alphas_cumprod_prev
            x = _at(np.sqrt(cleaner), index) * x0 + _at(np.sqrt(1.0 - cleaner), index) * eps
        elif sampler.kind == "ddpm":
            x = _at(process.posterior_x0, index) * x0 + _at(process.posterior_xt, index) * x
            if sampler.noisy_steps:
                scale = jnp.where(index > 0, sampler.temperature, 0.0)
                x += scale * jnp.exp(0.5 * predicted.log_variance) * noise_at(index)
        else:
            raise ValueError(f"sampler_step has no step of {sampler.kind!r}; add it there")
        return x, x0

    return step
