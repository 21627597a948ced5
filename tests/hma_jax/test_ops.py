import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ExecutionConfig
from hma_jax.kernels.ops import contract, gelu, normalise, over_tokens
from hma_jax.model.hma import declare_model
from tests.tiny import TABLE, lively_params, model_config, random_batch


def drawn(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def check_values_and_gradients(function, plain, *args):
    """Of a sum that weighs every entry differently."""

    def weighed(f):
        return jax.jit(jax.value_and_grad(lambda *a: jnp.sum(jnp.sin(f(*a))), argnums=tuple(range(len(args)))))(*args)

    for got, want in zip(jax.tree.leaves(weighed(function)), jax.tree.leaves(weighed(plain)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_normalise_has_the_gradients_of_its_formula():
    def plain(x):
        return (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + 1e-5)

    check_values_and_gradients(lambda x: normalise(x, 1e-5), plain, 3 + drawn(0, 2, 3, 5, 8))


def test_gelu_is_the_exact_one():
    x = np.concatenate([np.linspace(-12, 12, 97, dtype=np.float32), drawn(0, 31)])
    check_values_and_gradients(gelu, lambda x: jax.nn.gelu(x, approximate=False), x)


def test_the_gradient_over_tokens_is_their_sum():
    check_values_and_gradients(
        lambda x: over_tokens(x, 7), lambda x: jnp.repeat(x[:, :, None], 7, axis=2), drawn(0, 2, 3, 4)
    )


@pytest.mark.parametrize(
    "x, w, axes", [((3, 4, 5), (5, 2, 7), 1), ((3, 4, 5), (5, 2), 1), ((3, 2, 5), (2, 5, 4), 2)], ids=str
)
def test_contract_has_the_gradients_of_a_tensordot(x: tuple, w: tuple, axes: int):
    args = drawn(0, *x), drawn(1, *w)
    check_values_and_gradients(lambda a, b: contract(a, b, axes), lambda a, b: jnp.tensordot(a, b, axes), *args)


@pytest.mark.parametrize("remat", ["products", "everything"])
def test_a_block_keeps_less_than_it_computes(remat: str):
    """Per layer: with "everything" computed again its input alone, otherwise what is marked, and no norm or
    activation."""
    config = model_config(width=16, layers=3, tokens=12, action_tokens=4)
    batch = random_batch(0, config, 2)
    _, params = lively_params(config)
    declared = declare_model(config, TABLE, ExecutionConfig(remat=remat))

    def loss(p):
        said = declared.merge(p)(batch["tokens"], None, batch["actions"], batch["embodiment"])
        return jnp.sum(said.frames)

    _, backward = jax.vjp(loss, params)
    kept = sum(x.size for x in jax.tree.leaves(backward) if x.shape[:2] == (config.layers, 2))
    widths = kept / (config.layers * 2 * config.frames * config.frame_tokens * config.width)
    # The input; of both attentions queries, keys, values, result; three sums; MLP; the weights over time.
    marked = 1 + 8 + 3 + 4 + config.frames * config.heads / config.width
    assert widths == pytest.approx(1 if remat == "everything" else marked, rel=0.02)
