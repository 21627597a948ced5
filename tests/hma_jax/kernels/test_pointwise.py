import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.kernels.pointwise import gelu, layer_norm, over_tokens, replaced, scaled, shifted


def drawn(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def check_values_and_gradients(function, plain, *args):
    """Of a sum that weighs every entry differently."""

    def weighed(f):
        return jax.jit(jax.value_and_grad(lambda *a: jnp.sum(jnp.sin(f(*a))), argnums=tuple(range(len(args)))))(*args)

    for got, want in zip(jax.tree.leaves(weighed(function)), jax.tree.leaves(weighed(plain)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_layer_norm_has_the_gradients_of_its_formula():
    def plain(x):
        return (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + 1e-5)

    check_values_and_gradients(lambda x: layer_norm(x, 1e-5), plain, 3 + drawn(0, 2, 3, 5, 8))


def test_gelu_is_the_exact_one():
    x = np.concatenate([np.linspace(-12, 12, 97, dtype=np.float32), drawn(0, 31)])
    check_values_and_gradients(gelu, lambda x: jax.nn.gelu(x, approximate=False), x)


def test_the_gradient_over_tokens_is_their_sum():
    check_values_and_gradients(
        lambda x: over_tokens(x, 7), lambda x: jnp.repeat(x[:, :, None], 7, axis=2), drawn(0, 2, 3, 4)
    )


@pytest.mark.parametrize("shape", [(4,), (3, 1, 4), (2, 1, 1, 4), (5, 4)], ids=str)
def test_vectors_meet_rows_of_any_shape(shape: tuple[int, ...]):
    x, v, here = drawn(0, 2, 3, 5, 4), drawn(1, *shape), drawn(2, 2, 3, 5) > 0
    check_values_and_gradients(shifted, lambda x, v: x + v, x, v)
    check_values_and_gradients(scaled, lambda x, v: x * v, x, v)
    check_values_and_gradients(lambda x, v: replaced(x, here, v), lambda x, v: jnp.where(here[..., None], v, x), x, v)


@pytest.mark.parametrize(
    "meet", [shifted, lambda x, v: scaled(x + 1, v), lambda x, v: replaced(x, jnp.ones(len(x), bool), v)]
)
def test_the_gradient_of_what_rows_share_is_summed_in_float32(meet):
    """In bfloat16 a running sum stops growing at a few hundred equal terms."""
    x, v = jnp.zeros((4097, 2), jnp.bfloat16), jnp.ones(2)
    gradient = jax.grad(lambda v: jnp.sum(meet(x, v).astype(jnp.float32)))(v)
    np.testing.assert_array_equal(gradient, [4097, 4097])
