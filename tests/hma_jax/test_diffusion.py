"""The noising process and the terms of its training loss."""

from __future__ import annotations

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DiffusionConfig
from hma_jax.model.heads import timestep_embedding
from hma_jax.model.hma import declare_model
from hma_jax.objective.diffusion import diffusion_loss
from hma_jax.objective.losses import draw_noise, frame_diffusion_loss
from hma_jax.objective.process import (
    make_process,
    respace,
    respace_by_half_log_snr,
)
from tests.tiny import TABLE, shallow_config

FULL = make_process(1000)


# --- The process -----------------------------------------------------------------------------


def test_numbers_of_the_reference():
    """Reference section 11."""
    np.testing.assert_allclose(FULL.betas[[0, 500, 999]], [4.12842e-5, 3.15569e-3, 0.999], rtol=2e-6)
    want = [0.9999587, 0.845888, 0.492285, 0.143179, 2.42877e-9]
    np.testing.assert_allclose(FULL.alphas_cumprod[[0, 250, 500, 750, 999]], want, rtol=3e-6)
    want = [-10.734083, -10.734083, -10.343210]
    np.testing.assert_allclose(FULL.posterior_log_variance_clipped[:3], want, rtol=1e-7)
    short = respace(FULL, 100)
    assert np.flatnonzero(np.diff(short.timestep_map) == 11).tolist() == [5, 16, 27, 38, 49, 60, 71, 82, 93]
    np.testing.assert_allclose(short.betas[[0, 1, 50, 99]], [4.12842e-5, 6.79840e-4, 0.0341717, 0.99999], rtol=2e-6)
    frequencies = np.asarray(timestep_embedding(jnp.array(1)))[128:]  # their sines
    np.testing.assert_allclose(np.arcsin(frequencies[[0, 1, 2, 127]]), [1, 0.930572, 0.865964, 1.07461e-4], rtol=1e-5)


def test_respacing_keeps_the_noise_level_of_every_step_it_visits():
    short = respace(FULL, 37)
    np.testing.assert_allclose(short.alphas_cumprod, FULL.alphas_cumprod[short.timestep_map], rtol=1e-8)
    assert short.timestep_map[[0, -1]].tolist() == [0, 999]
    np.testing.assert_allclose(respace(FULL, 1000).betas, FULL.betas, rtol=1e-10)
    twice = respace(respace(FULL, 100), 10)
    np.testing.assert_allclose(twice.alphas_cumprod, FULL.alphas_cumprod[twice.timestep_map], rtol=1e-8)


@pytest.mark.parametrize("count", [1, 1001])
def test_a_process_cannot_be_respaced_to_any_length(count: int):
    with pytest.raises(ConfigError, match="between 2 and 1000"):
        respace(FULL, count)


@pytest.mark.parametrize("count", [2, 8, 10, 12, 100])
def test_spacing_by_log_snr_is_even_from_the_cleanest_step_to_where_the_signal_is_lost(count):
    short = respace_by_half_log_snr(FULL, count)
    assert short.timestep_map[0] == 0
    np.testing.assert_allclose(short.half_log_snr[[0, -1]], [5.0475, -4.0], atol=0.05)
    if count <= 12:  # with more, neighbouring steps of the process lie further apart than asked for
        np.testing.assert_allclose(np.diff(short.half_log_snr), -9.05 / (count - 1), atol=0.2)


@pytest.mark.parametrize("size", [2, 3, 20, 1000])
def test_spacing_by_log_snr_visits_every_step_at_most_once(size):
    process = make_process(size)
    for count in {2, min(12, size), size - 1, size} - {1}:
        chosen = respace_by_half_log_snr(process, count).timestep_map
        assert len(chosen) == count and np.all(np.diff(chosen) > 0) and chosen[-1] < size


# --- Training terms --------------------------------------------------------------------------


def rows_of_every_kind(rows: int = 64, channels: int = 5):
    """x0, t, noise and a network whose output does not follow its input."""
    rng = np.random.default_rng(3)
    x0, noise = rng.normal(size=(2, rows, channels)).astype(np.float32)
    t = rng.integers(1, 1000, rows)
    t[:4] = [1, 2, 998, 999]
    eps = noise + rng.normal(size=noise.shape).astype(np.float32) * 0.3
    variance = rng.uniform(-1, 1, noise.shape).astype(np.float32)
    return x0, t, noise, eps, variance


@jax.jit
def terms(x0, t, noise, eps, variance, valid=None):
    """diffusion_loss of a network that says (eps, variance)."""

    def network(x_t, t):
        return jnp.concatenate([eps, variance], axis=-1)

    return diffusion_loss(network, x0, t, noise, FULL, valid)


def kl_by_integration(mean_p, var_p, mean_q, var_q) -> np.ndarray:
    """KL(p | q) of Gaussians, in bits, summed up on a grid instead of in closed form."""
    z = np.linspace(-12, 12, 4001)
    x = mean_p[..., None] + np.sqrt(var_p)[..., None] * z
    p = np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    log_p = -(z**2) / 2 - np.log(var_p)[..., None] / 2
    log_q = -((x - mean_q[..., None]) ** 2) / (2 * var_q[..., None]) - np.log(var_q)[..., None] / 2
    return np.sum(p * (log_p - log_q), axis=-1) * (z[1] - z[0]) / math.log(2)


def test_bound_is_the_kl_between_the_posteriors_of_the_true_and_the_predicted_clean_vector():
    """Posteriors by Bayes' rule, as products of Gaussians, in float64."""
    x0, t, noise, eps, variance = rows_of_every_kind()
    _, vb = terms(x0, t, noise, eps, variance)

    beta, abar = FULL.betas[t][:, None], FULL.alphas_cumprod[t][:, None]
    abar_prev = abar / (1 - beta)
    x_t = np.sqrt(abar) * x0.astype(np.float64) + np.sqrt(1 - abar) * noise
    posterior_var = 1 / ((1 - beta) / beta + 1 / (1 - abar_prev)) * np.ones_like(x_t)

    def posterior_mean(clean):
        likelihood, prior = np.sqrt(1 - beta) / beta * x_t, np.sqrt(abar_prev) / (1 - abar_prev) * clean
        return posterior_var * (likelihood + prior)

    clean = (x_t - np.sqrt(1 - abar) * eps) / np.sqrt(abar)
    model_var = np.exp(np.log(beta) * (1 + variance) / 2 + np.log(posterior_var) * (1 - variance) / 2)
    want = kl_by_integration(posterior_mean(x0), posterior_var, posterior_mean(clean), model_var)
    np.testing.assert_allclose(vb, want.mean(-1), rtol=2e-4, atol=1e-5)


def test_at_step_0_the_bound_is_the_likelihood_of_the_bin_that_holds_the_clean_vector():
    x0 = np.array([[0.5, -0.2, 3.0, -3.0]])
    t, noise = np.zeros(1, int), np.array([[0.3, -1.0, 0.2, 1.1]])
    eps = noise + np.array([[0.4, -0.7, 0.3, -0.5]])
    variance = np.array([[-1.0, 0.5, 1.0, -1.0]])
    _, vb = terms(x0, t, noise, eps, variance)

    abar = FULL.alphas_cumprod[0]
    x_t = np.sqrt(abar) * x0 + np.sqrt(1 - abar) * noise
    mean = (x_t - np.sqrt(1 - abar) * eps) / np.sqrt(abar)
    low, high = FULL.posterior_log_variance_clipped[1], FULL.log_betas[0]
    std = np.exp((low + (high - low) * (variance + 1) / 2) / 2)
    cdf = np.vectorize(lambda z: 0.5 * (1 + math.erf(z / math.sqrt(2))))
    upper, lower = cdf((x0 + 1 / 255 - mean) / std), cdf((x0 - 1 / 255 - mean) / std)
    upper[:, 2], lower[:, 3] = 1, 0  # beyond +-0.999 the bin is open
    # The tanh approximation of the error function is good to three digits.
    np.testing.assert_allclose(vb, -np.log2(upper - lower).mean(-1), rtol=2e-3)


def test_the_bound_teaches_the_variance_only_and_the_error_the_noise_only():
    x0, t, noise, eps, variance = rows_of_every_kind()
    t[5] = 0

    def totals(eps, variance):
        return [v.sum() for v in terms(x0, t, noise, eps, variance)]

    (mse_eps, vb_eps), (mse_variance, vb_variance) = jax.jit(jax.jacrev(totals, (0, 1)))(eps, variance)
    assert np.all(mse_variance == 0) and np.all(vb_eps == 0)
    np.testing.assert_allclose(mse_eps, 2 * (eps - noise) / eps.shape[-1], rtol=1e-4, atol=1e-6)
    assert np.all(np.isfinite(vb_variance)) and np.mean(np.asarray(vb_variance) != 0) > 0.9


def test_padded_channels_change_neither_loss_nor_gradient():
    x0, t, noise, eps, variance = rows_of_every_kind()
    t[5] = 0
    want = terms(x0, t, noise, eps, variance)

    def rubbish(x):
        return np.pad(x, ((0, 0), (0, 3)), constant_values=7.0)

    x0, noise, eps, variance = map(rubbish, (x0, noise, eps, variance))
    eps[:, 5:] = -30.0
    valid = np.broadcast_to(np.arange(8) < 5, x0.shape)
    np.testing.assert_allclose(terms(x0, t, noise, eps, variance, valid), want, rtol=1e-5)

    def total(*out):
        return sum(v.sum() for v in terms(x0, t, noise, *out, valid))

    for gradient in jax.jit(jax.grad(total, (0, 1)))(eps, variance):
        assert np.all(gradient[:, 5:] == 0) and np.any(gradient[:, :5] != 0)


def test_the_network_sees_vectors_noised_to_their_step():
    x0, noise = jnp.full((2, 3, 4), 2.0), jnp.full((2, 3, 4), 0.5)
    t = jnp.array([[0, 250, 999], [1, 500, 750]])

    @jax.jit
    def run():
        seen = []

        def network(x_t, times):
            seen.extend([x_t, times])
            return jnp.zeros((2, 3, 8))

        return *diffusion_loss(network, x0, t, noise, FULL), *seen

    mse, vb, x_t, times = run()
    abar = FULL.alphas_cumprod[np.asarray(t)][..., None]
    np.testing.assert_allclose(x_t, np.sqrt(abar) * x0 + np.sqrt(1 - abar) * noise, rtol=1e-6)
    np.testing.assert_array_equal(times, t)
    np.testing.assert_allclose(mse, np.full((2, 3), 0.25), rtol=1e-6)
    assert vb.shape == (2, 3)


def test_the_error_of_the_noise_times_noise_over_signal_is_that_of_the_clean_vector():
    x0, t, noise, eps, variance = rows_of_every_kind()
    mse, _ = terms(x0, t, noise, eps, variance)
    abar = FULL.alphas_cumprod[t][:, None]
    x_t = np.sqrt(abar) * x0.astype(np.float64) + np.sqrt(1 - abar) * noise
    clean = (x_t - np.sqrt(1 - abar) * eps) / np.sqrt(abar)
    want = np.square(clean - x0).mean(-1)
    np.testing.assert_allclose(mse * FULL.noise_over_signal(math.inf)[t], want, rtol=1e-4)
    weights = FULL.noise_over_signal(20.0)
    assert weights.max() == 20.0 and np.all(np.diff(weights) >= 0) and np.sum(weights < 20.0) > 800


def test_the_weighed_loss_of_a_token_is_the_error_times_its_weight_and_the_bound_as_it_was():
    """A denoiser before its first step says 0, and errs by the noise itself."""
    config = DiffusionConfig(channels=3, patch=1, width=8, depth=1, weight_cap=2.0)
    model_config = shallow_config(diffusion=config)
    declared = declare_model(model_config, TABLE)
    params = declared.init(0)
    rng = np.random.default_rng(0)
    z, x0 = (jnp.asarray(rng.normal(size=(2, 3, 4, c)), jnp.float32) for c in (model_config.width, 3))
    keys = jax.random.split(jax.random.key(0), 2)

    @jax.jit
    def losses():
        model = declared.merge(params)
        return [frame_diffusion_loss(model, z, x0, keys, training=training) for training in (False, True)]

    plain, weighed = losses()
    time, noise = jax.vmap(lambda k: draw_noise(jax.random.fold_in(k, 0), x0.shape[1:], config.steps))(keys)
    weight = FULL.noise_over_signal(2.0)[np.asarray(time)]
    np.testing.assert_allclose(weighed, plain + (weight - 1) * np.square(noise).mean(-1), rtol=1e-4, atol=1e-5)


def test_the_loss_of_a_token_is_the_mean_over_repeats_that_noise_it_anew():
    """A denoiser that says 0 errs by the noise: each loss tells what was drawn."""
    x0, keys = jnp.ones((2, 3, 4, 3)), jax.random.split(jax.random.key(0), 2)

    def network(x, *_):
        return jnp.concatenate([jnp.zeros_like(x)] * 2, axis=-1)

    def loss(repeats):
        diffusion = DiffusionConfig(channels=3, patch=1, repeats=repeats)
        model = SimpleNamespace(config=SimpleNamespace(diffusion=diffusion), denoiser=network)
        return frame_diffusion_loss(model, x0, x0, keys, training=False)

    def repeat(number):
        time, noise = jax.vmap(lambda k: draw_noise(jax.random.fold_in(k, number), x0.shape[1:], 1000))(keys)
        return sum(diffusion_loss(network, x0, time, noise, FULL))

    first, mean, *each = map(np.asarray, jax.jit(lambda: [loss(1), loss(2), repeat(0), repeat(1)])())
    np.testing.assert_allclose(first, each[0], rtol=1e-5)
    np.testing.assert_allclose(mean, np.mean(each, axis=0), rtol=1e-5)
    assert np.all(np.abs(each[0] - each[1]) > 1e-4)


def test_the_gradient_of_a_weight_is_one_product_over_all_tokens_of_a_batch():
    """With a product for each example XLA's CPU compiler runs the sum over them as a slow loop."""
    config = shallow_config(diffusion=DiffusionConfig(channels=3, patch=1, width=8, depth=1))
    declared = declare_model(config, TABLE)
    z, x0, keys = jnp.zeros((2, 3, 4, config.width)), jnp.ones((2, 3, 4, 3)), jax.random.split(jax.random.key(0), 2)

    def loss(params):
        return frame_diffusion_loss(declared.merge(params), z, x0, keys, training=True).sum()

    program = jax.jit(jax.grad(loss)).lower(declared.init(0)).as_text()
    assert program.count("dot_general") > 10 and "batching_dims" not in program


def test_shifted_steps_are_drawn_as_often_as_the_shift_says():
    """P(time < t) = u with k u / (1 + (k - 1) u) = t / steps; without a shift, evenly."""
    key, shape = jax.random.key(0), (20_000, 1)
    for k in (0.5, 1.0, 4.0):
        time, noise = draw_noise(key, shape, 100, k)
        assert time.min() >= 0 and time.max() < 100
        for share in (0.2, 0.5, 0.9):
            want = share / (k - (k - 1) * share)
            assert abs(float(np.mean(np.asarray(time) < 100 * share)) - want) < 0.02, (k, share)
        np.testing.assert_array_equal(noise, draw_noise(key, shape, 100)[1])


@pytest.mark.parametrize("k", [0.25, 4.0, 8.0])
def test_every_step_is_drawn_whatever_the_shift(k):
    """At 4 a third of 1000 steps never was, among them the first, with which every sampler ends."""
    time = np.asarray(draw_noise(jax.random.key(0), (1_000_000, 1), 1000, k)[0])
    edges = np.arange(1001) / 1000
    want = len(time) * np.diff(edges / (k - (k - 1) * edges))
    assert (np.abs(np.bincount(time, minlength=1000) - want) < 6 * np.sqrt(want)).all() and want.min() > 50
    assert np.asarray(draw_noise(jax.random.key(0), (1000, 1), 1000, 1e30)[0]).max() == 999


def test_a_shift_of_whole_steps_draws_their_middles():
    """The middles of four steps, at 3 u / (1 + 2 u): 1.2, 2.6, 3.3 and 3.8 of four."""
    time = np.asarray(draw_noise(jax.random.key(0), (20_000, 1), 4, time_shift=3.0)[0])
    np.testing.assert_allclose(np.bincount(time, minlength=4) / len(time), [0, 1 / 4, 1 / 4, 1 / 2], atol=0.02)
    with pytest.raises(ConfigError, match="two ways of one shift; set only one"):
        DiffusionConfig(noise_shift=4.0, time_shift=4.0)
