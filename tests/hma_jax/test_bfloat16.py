"""Gradients in bfloat16 beside those in float32, on tokens of which one is nearly everywhere.

Sums over many equal terms are where bfloat16 fails: with eight bits a running sum stops growing at a few hundred.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import DiffusionConfig, ExecutionConfig, MaskingConfig
from hma_jax.model.hma import declare_model
from hma_jax.objective.losses import masked_loss
from tests.tiny import TABLE, lively_params, mask, model_config, random_batch

ROWS = 48
LATENTS = DiffusionConfig(channels=2, patch=1, width=32, depth=2, steps=20)


def gradients(dtype: str, diffusion: DiffusionConfig | None, rounded: bool = False) -> dict[str, np.ndarray]:
    """`rounded`: of parameters in bfloat16, whatever computes."""
    config, gradient = model_config(diffusion=diffusion), gradient_in(dtype, diffusion)
    _, params = lively_params(config, scale=0.05)
    if rounded:
        params = jax.tree.map(lambda x: x.astype(jnp.bfloat16).astype(x.dtype), params)
    names = declare_model(config, TABLE).leaves()
    return {name: np.asarray(g) for name, g in zip(names, jax.tree.leaves(gradient(params)), strict=True)}


@cache
def gradient_in(dtype: str, diffusion: DiffusionConfig | None) -> Callable:
    config = model_config(diffusion=diffusion)
    declared = declare_model(config, TABLE, ExecutionConfig(dtype))
    batch = random_batch(0, config, ROWS)
    if diffusion is None:
        rare = np.random.default_rng(1).random(batch["tokens"].shape) < 0.03
        batch["tokens"] = np.where(rare, batch["tokens"], 7)
    masking = MaskingConfig("full", max_corrupt_rate=0.0)  # corrupted tokens would not be skewed
    masked = mask(jax.random.key(0), batch["tokens"], batch["embodiment"], config, masking, TABLE)
    keys = jax.random.split(jax.random.key(1), ROWS)

    @jax.jit
    def gradient(params):
        def loss(params):
            robots = batch["embodiment"]
            model = declared.merge(params)
            sums = masked_loss(
                model, masked, batch["tokens"], batch["actions"], robots, masking, keys, robots, training=True
            )
            return sums.tokens + sums.actions

        return jax.grad(loss)(params)

    return gradient


@pytest.mark.parametrize("diffusion", [None, pytest.param(LATENTS, marks=pytest.mark.slow)], ids=["ids", "latents"])
def test_gradients_in_bfloat16_are_those_in_float32_within_its_rounding(diffusion):
    exact, computed = gradients("float32", diffusion), gradients("bfloat16", diffusion)
    assert all(g.dtype == np.float32 for g in computed.values())
    off = {name: error for name in exact if (error := apart(computed[name], exact[name])) >= 0.02}
    if off:  # one rounding is 0.004 at most; some gradients change by more when the parameters alone are rounded
        alone = gradients("float32", diffusion, rounded=True)
        off = {name: error for name, error in off.items() if error >= min(apart(alone[name], exact[name]), 0.1)}
    assert not off


@pytest.mark.parametrize("diffusion", [None, LATENTS], ids=["ids", "latents"])
def test_what_heads_predict_is_not_rounded_to_bfloat16(diffusion):
    """A denoiser's noise is added up over the steps of a sampler, and an action goes to a robot as it is."""
    config = model_config(diffusion=diffusion)
    declared = declare_model(config, TABLE, ExecutionConfig("bfloat16"))
    z, x = (np.random.default_rng(n).normal(size=(2, 3, n)).astype(np.float32) for n in (config.width, 2))
    robots = np.arange(2)

    @jax.jit
    def predicted(params, z_BTD, x_BTC):
        model, time = declared.merge(params), jnp.zeros((2, 3), jnp.int32)
        if diffusion is None:
            return [model.action_head(z_BTD.astype(jnp.bfloat16), robots)]
        x_BTU = jnp.resize(x_BTC, (2, 3, TABLE.action_width))
        return model.denoiser(x_BTC, time, z_BTD), model.action_head(x_BTU, time, z_BTD, robots)

    for y in map(np.asarray, predicted(lively_params(config)[1], z, x)):
        live = y[y != 0]
        assert y.dtype == np.float32 and np.mean(live == live.astype(jnp.bfloat16).astype(np.float32)) < 0.1


def test_a_small_change_of_the_last_bias_reaches_what_both_denoisers_predict():
    """Rounded to bfloat16, 1.001 is 1, and a bias would be trained in steps of 0.008."""
    config = model_config(diffusion=LATENTS)
    declared = declare_model(config, TABLE, ExecutionConfig("bfloat16"))
    z, x = (np.random.default_rng(n).normal(size=(2, 3, n)).astype(np.float32) for n in (config.width, 2))

    @jax.jit
    def predicted(params, bias):
        out_bias = lambda path, p: jnp.full_like(p, bias) if path[-1].key == "out_bias" else p
        model, time = declared.merge(jax.tree.map_with_path(out_bias, params)), jnp.zeros((2, 3), jnp.int32)
        x_BTU = jnp.resize(x, (2, 3, TABLE.action_width))
        return model.denoiser(x, time, z), model.action_head(x_BTU, time, z, np.arange(2))

    params = lively_params(config)[1]
    for before, after in zip(predicted(params, 1.0), predicted(params, 1.001), strict=True):
        np.testing.assert_allclose(after - before, 0.001, atol=1e-5)


def apart(g: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(g - exact) / np.linalg.norm(exact))
