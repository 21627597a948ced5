"""Schedules and tables against those of the official release."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.diffusion import Process, make_process, respace, timestep_embedding
from hma_jax.config import ModelConfig
from hma_jax.decoding import masked_counts

TABLES = Path(__file__).parent / "11_tables"


def load(name: str) -> dict:
    return json.loads((TABLES / f"{name}.json").read_text())


def check_process(process: Process, want: dict, rows) -> None:
    """Every table that is both ours and theirs, at `rows`."""
    ours = {
        "betas": process.betas,
        "alphas_cumprod": process.alphas_cumprod,
        "alphas_cumprod_prev": process.alphas_cumprod_prev,
        "posterior_mean_coef1": process.posterior_x0,
        "posterior_mean_coef2": process.posterior_xt,
        "sqrt_recip_alphas_cumprod": process.clean_from_xt,
        "sqrt_recipm1_alphas_cumprod": process.clean_from_eps,
    }
    for name in ours.keys() & want.keys():
        np.testing.assert_allclose(ours[name][rows], want[name], rtol=1e-12, atol=0, err_msg=name)
    logarithms = process.posterior_log_variance_clipped[rows]
    np.testing.assert_allclose(logarithms, want["posterior_log_variance_clipped"], rtol=1e-9, atol=0)


def test_cosine_process():
    want = load("diffusion_1000")
    check_process(make_process(1000), want, want["index"])


@pytest.mark.parametrize("count", [100, 10])
def test_respaced_process(count: int):
    want, process = load("diffusion_respaced")[str(count)], respace(make_process(1000), count)
    check_process(process, want, slice(None))
    assert process.timestep_map.tolist() == want["timestep_map"]


def test_respaced_steps_round_as_released():
    for count, want in load("respaced_indices").items():
        assert respace(make_process(1000), int(count)).timestep_map.tolist() == want


def test_timestep_embedding():
    want = load("timestep_embedding")
    got = timestep_embedding(jnp.array(want["timesteps"]), want["dim"])
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, want["embedding"], rtol=0, atol=1e-4)


def test_unmasking_follows_the_cosine_schedule():
    want, many = load("cosine_schedule"), 10**12
    steps = len(want["u"]) - 1
    np.testing.assert_allclose(np.array(masked_counts(ModelConfig(tokens=many), steps)) / many, want["value"][1:], rtol=1e-11, atol=1e-12)
