import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.kernels.pointwise import gelu, layer_norm, over_tokens


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
