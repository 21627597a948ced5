from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.model.attention import attend_within
from hma_jax.model.layers import contract
from tests.tiny import lively_params, model_config, random_batch


def drawn(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def plain(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    weights = jax.nn.softmax(jnp.einsum("btphi,btshi->bthps", q, k), axis=-1)
    return jnp.einsum("bthps,btshi->btphi", weights, v)


def gradients(attend):
    seen = jnp.asarray(drawn(3, 2, 3, 7, 2, 5))
    return jax.jit(jax.value_and_grad(lambda *qkv: jnp.sum(attend(*qkv) * seen), argnums=(0, 1, 2)))


def test_attention_one_frame_at_a_time_equals_all_at_once():
    qkv = [drawn(i, 2, 3, 7, 2, 5) for i in range(3)]
    got, want = gradients(attend_within)(*qkv), gradients(plain)(*qkv)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), got, want)


@pytest.mark.parametrize(
    "x, w, axes", [((3, 4, 5), (5, 2, 7), 1), ((3, 4, 5), (5, 2), 1), ((3, 2, 5), (2, 5, 4), 2)], ids=str
)
def test_contract_has_the_gradients_of_a_tensordot(x: tuple, w: tuple, axes: int):
    args = drawn(0, *x), drawn(1, *w)
    square = lambda product: jax.grad(lambda a, b: jnp.sum(product(a, b, axes) ** 2), argnums=(0, 1))(*args)  # noqa: E731
    for got, want in zip(square(contract), square(jnp.tensordot), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)


def test_a_model_says_the_same_whichever_way_it_attends():
    config = model_config(width=16, layers=1, tokens=260, action_tokens=4)
    batch = random_batch(0, config, 2)
    said = []
    for how in ("by_frame", "whole"):
        declared, params = lively_params(replace(config, attention=how))
        look = jax.jit(lambda p, d=declared: d.merge(p)(batch["tokens"], None, batch["actions"], batch["embodiment"]).frames)
        said.append(np.asarray(look(params)))
    np.testing.assert_allclose(*said, atol=1e-4 * np.abs(said[1]).max())
