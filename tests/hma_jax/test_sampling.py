"""Sampling where the right answer is known: Gaussian data and mixtures, for which the best network is a formula."""

from __future__ import annotations

import math
import re
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, SamplerConfig
from hma_jax.config.evaluation import SamplerKind
from hma_jax.config.json import from_dict, to_dict
from hma_jax.objective.diffusion import sample
from hma_jax.objective.process import (
    Process,
    make_process,
    respace,
    respace_by_half_log_snr,
    sampling_process,
)
from tests.sampling import sample_recorded, trajectory_of

FULL = make_process(1000)
MEAN, STD = np.array([2.0, -1.0, 0.3], np.float32), 0.6
CLIP = 10.0


def gaussian_network(process: Process, mean=MEAN):
    """The best prediction of noise and variance when x0 ~ N(mean, STD^2), for steps of `process`."""
    abar = process.alphas_cumprod
    var_xt = abar * STD**2 + 1 - abar
    slope = np.sqrt(1 - abar) / var_xt
    var_x0 = STD**2 * (1 - abar) / var_xt  # of x0 given x_t
    low, high = process.posterior_log_variance_clipped, process.log_betas
    variance = np.exp(low) + process.posterior_x0**2 * var_x0
    fraction = (np.log(variance) - low)[1:] / (high - low)[1:]
    fraction = np.append(0.0, fraction)  # the last step draws nothing

    def at(table, t):
        return jnp.asarray(table, jnp.float32)[t][..., None]

    def network(x_t, t):
        index = jnp.searchsorted(jnp.asarray(process.timestep_map), t)
        eps = at(slope, index) * (x_t - at(np.sqrt(abar), index) * mean)
        return jnp.concatenate([eps, jnp.broadcast_to(at(2 * fraction - 1, index), x_t.shape)], -1)

    return network


def drawn(sampler: SamplerConfig, rows: int = 20_000, seed: int = 0) -> np.ndarray:
    process = sampling_process(FULL, sampler)
    network = gaussian_network(process)
    draw = jax.jit(lambda key: sample(network, key, (rows, 3), process, sampler, CLIP))
    return np.asarray(draw(jax.random.key(seed)))


def ddim_spread(steps: int) -> float:
    """Standard deviation that DDIM gives Gaussian data: every step multiplies x by a number."""
    process, spread = respace(FULL, steps), 1.0
    for abar, cleaner in zip(process.alphas_cumprod[::-1], process.alphas_cumprod_prev[::-1], strict=True):
        slope = np.sqrt(1 - abar) / (abar * STD**2 + 1 - abar)  # of the predicted noise
        clean = (1 - np.sqrt(1 - abar) * slope) / np.sqrt(abar)
        spread *= np.sqrt(cleaner) * clean + np.sqrt(1 - cleaner) * slope
    return spread


class Known(NamedTuple):
    """What is known of a sampler's results."""

    spreads: dict[SamplerConfig, float]  # standard deviation of what it makes of Gaussian data
    mean_within: float = 0.02  # how far their mean may lie from that of the data
    spread_within: float = 0.02  # the same of the spread, as a share of it
    near: float = 1e-3  # how far its 20 steps may lie from a result without error


KNOWN = {
    # With the best variance ancestral steps are exact however few.
    "ddpm": Known({SamplerConfig("ddpm", steps): STD for steps in (10, 100)}),
    "ddim": Known({SamplerConfig("ddim", steps): ddim_spread(steps) for steps in (100, 5)}),
    "dpm++": Known(
        {SamplerConfig("dpm++", n, eta=eta): STD for n in (8, 10, 12) for eta in (0.0, 0.5)}, 0.05, 0.06, 0.03
    ),
}
NEAR = [(kind, known.near) for kind, known in KNOWN.items()]


def test_every_sampler_is_tested_here():
    assert set(KNOWN) == set(get_args(SamplerKind)), "add yours to KNOWN"


@pytest.mark.parametrize(
    "sampler",
    [sampler for known in KNOWN.values() for sampler in known.spreads],
    ids=lambda s: f"{s.kind}-{s.steps}-{s.eta}",
)
def test_samples_have_the_mean_and_spread_of_the_data(sampler):
    samples, known = drawn(sampler), KNOWN[sampler.kind]
    np.testing.assert_allclose(samples.mean(0), MEAN, atol=known.mean_within)
    np.testing.assert_allclose(samples.std(0), known.spreads[sampler], rtol=known.spread_within)
    assert np.all(np.abs(np.corrcoef(samples.T) - np.eye(3)) < 0.03)


WEIGHTS, CENTRES = np.array([0.5, 0.3, 0.2]), np.array([[1.5, 0.0], [-1.0, 0.5], [0.0, -1.5]])
STDS = np.array([0.1, 0.3, 0.2])


def mixture_network(x_t, t):
    """The exact prediction of the noise for a mixture of Gaussians; the variance is the posterior's and beta's mean."""
    a = jnp.asarray(FULL.alphas_cumprod, jnp.float32)[t][..., None]
    spread = a * STDS**2 + 1 - a  # [..., 3], of x_t
    distance = x_t[..., None, :] - jnp.sqrt(a)[..., None] * CENTRES
    log_p = jnp.log(WEIGHTS) - jnp.sum(distance**2, -1) / (2 * spread) - jnp.log(spread)  # of two dimensions
    score = jax.nn.softmax(log_p, -1)[..., None] * distance / spread[..., None]
    eps = jnp.sqrt(1 - a) * jnp.sum(score, -2)
    return jnp.concatenate([eps, jnp.zeros_like(eps)], -1)


def from_mixture(sampler: SamplerConfig, rows: int = 20_000) -> np.ndarray:
    process = sampling_process(FULL, sampler)
    draw = jax.jit(lambda key: sample(mixture_network, key, (rows, 2), process, sampler, CLIP))
    return np.asarray(draw(jax.random.key(0)))


def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean [2], spread [2], share of each component [3]) of samples [n, 2]."""
    score = np.sum((x[:, None] - CENTRES) ** 2, -1) / (2 * STDS**2) + 2 * np.log(STDS) - np.log(WEIGHTS)
    return x.mean(0), x.std(0), np.bincount(np.argmin(score, axis=1), minlength=3) / len(x)


@pytest.mark.parametrize(
    "steps, eta",
    [(10, 0.5), *(pytest.param(*p, marks=pytest.mark.slow) for p in [(8, 0.0), (10, 0.0), (12, 0.0), (12, 0.5)])],
)
def test_a_few_steps_of_dpm_have_the_moments_of_a_mixture_and_of_100_ancestral_steps(steps, eta):
    found = moments(from_mixture(SamplerConfig("dpm++", steps, eta=eta)))
    mean = WEIGHTS @ CENTRES
    spread = np.sqrt(WEIGHTS @ (CENTRES**2 + STDS[:, None] ** 2) - mean**2)
    for want in (mean, spread, WEIGHTS), moments(from_mixture(SamplerConfig())):
        np.testing.assert_allclose(found[0], want[0], atol=0.05)
        np.testing.assert_allclose(found[1], want[1], rtol=0.1)
        np.testing.assert_allclose(found[2], want[2], atol=0.03)


def test_dpm_starts_where_an_error_of_the_network_does_no_harm():
    """What DDIM with few steps loses by: at the last step of the process a hundredth of the noise wrong makes a clean
    vector 200 wrong, cut off at the clip, and the next step, far away and deterministic, keeps its share of that."""
    start = jnp.asarray(np.random.default_rng(0).normal(size=(200, 3)), jnp.float32)
    moved = {}
    for sampler in (SamplerConfig("ddim", 25), SamplerConfig("dpm++", 10, eta=0.0)):
        process = sampling_process(FULL, sampler)
        exact = gaussian_network(process)

        def wrong(x, t, exact=exact):
            return exact(x, t) + jnp.repeat(jnp.array([0.01, 0.0]), 3)

        samples = (np.asarray(sample_recorded(n, start, None, process, sampler, CLIP)) for n in (exact, wrong))
        moved[sampler.kind] = np.abs(np.subtract(*samples)).mean() / STD
    assert moved["ddim"] > 0.2 and moved["dpm++"] < 0.05, moved


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_dpm_is_the_multistep_formula_of_second_order(eta):
    """By hand, in float64 (Lu et al. 2022, algorithm 2, and its stochastic form), with a simple network."""
    process, sampler = respace_by_half_log_snr(FULL, 5), SamplerConfig("dpm++", 5, temperature=0.7, eta=eta)
    noise = np.random.default_rng(1).normal(size=(6, 1, 2)).astype(np.float32)
    told = np.array([[0.5, -1.5]])

    def network(x_t, t):
        return jnp.concatenate([jnp.asarray(told) * (1 + x_t), jnp.zeros((1, 2))], -1)

    visited = trajectory_of(network, noise[0], noise[1:] if eta else None, process, sampler, CLIP)
    signal, spread = np.sqrt(process.alphas_cumprod), np.sqrt(1 - process.alphas_cumprod)
    x, before, stride_before = 0.7 * noise[0].astype(np.float64), None, None
    for step, index in enumerate([4, 3, 2, 1, 0]):
        clean = np.clip((x - spread[index] * told * (1 + x)) / signal[index], -CLIP, CLIP)
        if index == 0:
            x = clean
        else:
            stride = np.log(signal / spread)[index - 1] - np.log(signal / spread)[index]
            ahead = clean
            if before is not None:
                r = stride_before / stride
                ahead = (1 + 1 / (2 * r)) * clean - 1 / (2 * r) * before
            x = spread[index - 1] / spread[index] * np.exp(-eta * stride) * x
            x = x - signal[index - 1] * np.expm1(-(1 + eta) * stride) * ahead
            x = x + 0.7 * spread[index - 1] * np.sqrt(-np.expm1(-2 * eta * stride)) * noise[1 + step]
            before, stride_before = clean, stride
        np.testing.assert_allclose(visited.x[step], x, rtol=1e-3, atol=1e-4)


def test_ddim_nears_the_spread_of_the_data_with_more_steps():
    lost = [1 - ddim_spread(steps) / STD for steps in (5, 10, 100, 1000)]
    assert lost == sorted(lost, reverse=True)
    np.testing.assert_allclose(lost, [0.305, 0.146, 0.015, 0.0015], rtol=0.1)


def test_the_learned_variance_decides_the_spread_of_ancestral_samples():
    """Two steps: the last draws nothing, so the first one's variance is what samples have."""
    process, sampler = respace(FULL, 2), SamplerConfig(steps=2)
    network = gaussian_network(process)

    def narrow(x_t, t):
        eps, _ = jnp.split(network(x_t, t), 2, axis=-1)
        return jnp.concatenate([eps, -jnp.ones_like(eps)], -1)

    draw = jax.jit(lambda key: sample(narrow, key, (20_000, 3), process, sampler, CLIP))
    np.testing.assert_allclose(drawn(sampler).std(0), STD, rtol=0.02)
    assert np.all(draw(jax.random.key(0)).std(0) < 0.02)


@pytest.mark.parametrize("kind, near", NEAR)
def test_temperature_0_depends_on_the_condition_alone(kind, near):
    one, other = (drawn(SamplerConfig(kind, 20, temperature=0.0), 4, seed) for seed in (0, 1))
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one, np.broadcast_to(MEAN, one.shape), atol=near)


def test_temperature_0_as_released_still_depends_on_the_initial_noise():
    """Data at +1 and -1: without noise in the steps, the start decides where a sample ends."""
    process = respace(FULL, 20)
    abar = jnp.asarray(FULL.alphas_cumprod, jnp.float32)

    def network(x_t, t):
        a = abar[t][..., None]
        eps = (x_t - jnp.sqrt(a) * jnp.tanh(jnp.sqrt(a) * x_t / (1 - a))) / jnp.sqrt(1 - a)
        return jnp.concatenate([eps, jnp.zeros_like(eps)], -1)

    start = jnp.array([[0.5], [-0.5]])
    ours = SamplerConfig(steps=20, temperature=0.0)
    released = SamplerConfig(steps=20, temperature=0.0, scale_initial_noise=False)
    np.testing.assert_allclose(sample_recorded(network, start, None, process, released, CLIP), [[1], [-1]], atol=0.01)
    np.testing.assert_array_equal(sample_recorded(network, start, None, process, ours, CLIP), [[0], [0]])


@pytest.mark.parametrize("kind, near", NEAR)
def test_spread_is_proportional_to_temperature(kind, near):
    """For Gaussian data sampling is linear in the noise; `dpm++` starts where the mean already shows."""
    process = sampling_process(FULL, SamplerConfig(kind, 20))
    network = gaussian_network(process)
    noise = np.random.default_rng(0).normal(size=(21, 8, 3)).astype(np.float32)
    whole, half = (
        sample_recorded(network, noise[0], noise[1:], process, SamplerConfig(kind, 20, temperature=v), CLIP)
        for v in (1.0, 0.5)
    )
    assert np.abs(whole - MEAN).max() > 0.5
    np.testing.assert_allclose(half - MEAN, (whole - MEAN) / 2, atol=near)


@pytest.mark.parametrize("kind", KNOWN)
def test_predicted_clean_vectors_are_clipped_and_the_last_is_the_sample(kind):
    process = respace(FULL, 20)
    network = gaussian_network(process, mean=np.array([5.0, -5.0, 0.0], np.float32))
    noise = np.random.default_rng(0).normal(size=(21, 6, 3)).astype(np.float32)
    args = network, noise[0], noise[1:], process, SamplerConfig(kind, 20), 1.5
    got, visited = sample_recorded(*args), trajectory_of(*args)
    assert visited.x.shape == visited.x0.shape == (20, 6, 3)
    assert np.abs(visited.x0).max() == 1.5
    np.testing.assert_allclose(visited.x[-1], visited.x0[-1], atol=1e-6)
    np.testing.assert_allclose(got, visited.x[-1], atol=1e-4)  # another program


def test_ddim_moves_along_the_noise_that_the_clipped_clean_vector_leaves():
    """By hand, in float64, with a network that always points far outside."""
    process = respace(FULL, 4)
    x = np.array([[0.3, -0.2]])
    visited = trajectory_of(lambda x_t, t: jnp.full((1, 4), 3.0), x, None, process, SamplerConfig("ddim", 4), 1.0)
    for step, index in enumerate([3, 2, 1, 0]):
        abar, cleaner = process.alphas_cumprod[index], process.alphas_cumprod_prev[index]
        clean = np.clip((x - np.sqrt(1 - abar) * 3.0) / np.sqrt(abar), -1, 1)
        noise = (x - np.sqrt(abar) * clean) / np.sqrt(1 - abar)
        x = np.sqrt(cleaner) * clean + np.sqrt(1 - cleaner) * noise
        np.testing.assert_allclose(visited.x[step], x, rtol=1e-4, atol=1e-5)


def test_recorded_noise_goes_from_the_noisiest_step_to_the_last_which_adds_none():
    process, sampler = respace(FULL, 5), SamplerConfig(steps=5)
    network = gaussian_network(process)
    noise = np.random.default_rng(0).normal(size=(6, 2, 3)).astype(np.float32)

    @jax.jit
    def x_after(steps):
        return trajectory_of(network, noise[0], steps, process, sampler, CLIP).x

    base = x_after(noise[1:])
    for position in range(5):
        changed = noise[1:].copy()
        changed[position] += 1
        moved = np.abs(x_after(changed) - base).max(axis=(1, 2)) > 0
        assert moved.tolist() == [position < 4 and step >= position for step in range(5)]


def test_the_network_is_told_steps_of_the_original_process():
    process = respace(FULL, 5)
    told = []

    def network(x_t, t):
        jax.debug.callback(lambda t: told.append(t.tolist()), t, ordered=True)
        return jnp.zeros((*x_t.shape[:-1], 2 * x_t.shape[-1]))

    sample_recorded(network, jnp.zeros((2, 3)), None, process, SamplerConfig("ddim", 5), CLIP).block_until_ready()
    jax.effects_barrier()
    assert told == [[step] for step in process.timestep_map[::-1]]


def test_samples_of_an_example_do_not_depend_on_its_neighbours():
    process, sampler = respace(FULL, 5), SamplerConfig(steps=5)
    network, keys = gaussian_network(process), jax.random.split(jax.random.key(0), 4)
    together = sample(network, keys, (4, 7, 3), process, sampler, CLIP)
    alone = sample(network, keys[2], (7, 3), process, sampler, CLIP)
    np.testing.assert_allclose(together[2], alone, rtol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 0.1


def test_sampling_does_not_hold_the_noise_of_all_steps():
    process, sampler = respace(FULL, 100), SamplerConfig()
    shape = (1000, 3)
    program = jax.jit(lambda key: sample(gaussian_network(process), key, shape, process, sampler, CLIP)).lower(
        jax.random.key(0)
    )
    assert program.compile().memory_analysis().temp_size_in_bytes < 100 * 4 * math.prod(shape) / 4


def test_what_cannot_be_sampled_is_refused():
    process, x = respace(FULL, 5), jnp.zeros((2, 3))
    network = gaussian_network(process)
    with pytest.raises(ConfigError, match="steps is 6 but the process has 5"):
        sample_recorded(network, x, jnp.zeros((6, 2, 3)), process, SamplerConfig(steps=6), CLIP)
    with pytest.raises(ConfigError, match="first axes"):
        keys = jax.random.split(jax.random.key(0), 3)
        sample(network, keys, (2, 3), process, SamplerConfig(steps=5), CLIP)
    for kind in ("ddim", "dpm++"):
        with pytest.raises(ConfigError, match=f"no effect on {re.escape(kind)}"):
            SamplerConfig(kind, temperature=0.5, scale_initial_noise=False, eta=0.0)


@pytest.mark.parametrize("eta", [-0.1, 1.1])
def test_an_eta_outside_its_range_is_refused(eta):
    with pytest.raises(ConfigError, match="sampler.eta must lie in"):
        SamplerConfig("dpm++", 10, eta=eta)


def test_sampler_settings_survive_json():
    settings = SamplerConfig("ddim", 25, 0.5)
    assert from_dict(SamplerConfig, to_dict(settings)) == settings
