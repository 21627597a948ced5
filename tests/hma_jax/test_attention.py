import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ExecutionConfig
from hma_jax.kernels import attend
from hma_jax.model.hma import declare_model
from tests.tiny import TABLE, lively_params, model_config, random_batch


def drawn(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def plain(qkv: jax.Array, scale: float) -> jax.Array:
    q, k, v = (qkv[:, :, :, n] for n in range(3))
    weights = jax.nn.softmax(scale * jnp.einsum("btphi,btshi->bthps", q, k), axis=-1)
    return jnp.einsum("bthps,btshi->btphi", weights, v)


def value_and_gradient(function, qkv):
    seen = jnp.asarray(drawn(3, 2, 3, 7, 2, 5))
    return jax.jit(jax.value_and_grad(lambda qkv: jnp.sum(function(qkv, 0.7) * seen)))(qkv)


@pytest.mark.parametrize("split", [False, True], ids=["one frame at a time", "as on an accelerator"])
def test_attention_within_frames_has_the_values_and_gradients_of_plain_attention(split: bool, monkeypatch):
    monkeypatch.setattr(attend, "is_split", lambda: split)
    qkv = drawn(0, 2, 3, 7, 3, 2, 5)
    got, want = value_and_gradient(attend.attend_within, qkv), value_and_gradient(plain, qkv)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), got, want)


def test_a_model_says_the_same_whichever_way_it_attends():
    config = model_config(width=16, layers=1, tokens=260, action_tokens=4)
    batch = random_batch(0, config, 2)
    said = []
    _, params = lively_params(config)
    for how in ("auto", "plain"):
        declared = declare_model(config, TABLE, ExecutionConfig(attention=how))
        look = jax.jit(lambda p, d=declared: d.merge(p)(batch["tokens"], None, batch["actions"], batch["embodiment"]).frames)
        said.append(np.asarray(look(params)))
    np.testing.assert_allclose(*said, atol=1e-4 * np.abs(said[1]).max())
