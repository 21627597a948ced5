"""Every backend of attention has the values and the gradients of the plain one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.kernels import attention, cpu, cudnn, plain, splash
from hma_jax.model.hma import declare_model
from tests.tiny import TABLE, lively_params, model_config, random_batch

SCALE = 0.7


def drawn(seed: int, *shape: int, dtype=jnp.float32) -> jax.Array:
    return jax.device_put(np.random.default_rng(seed).standard_normal(shape).astype(jnp.dtype(dtype)))


def value_and_gradients(function, *args):
    """Of a sum that weighs every entry of the result differently."""
    seen = np.random.default_rng(9)

    def loss(*args):
        y = function(*args).astype(jnp.float32)
        return jnp.sum(y * seen.standard_normal(y.shape).astype(np.float32)), y

    gradients, y = jax.jit(jax.grad(loss, argnums=tuple(range(len(args))), has_aux=True))(*args)
    return y, *gradients


def check_equal(function, reference, *args, tolerance: float):
    seen = value_and_gradients(function, *args), value_and_gradients(reference, *args)
    for got, want in zip(*seen, strict=True):
        assert got.dtype == want.dtype
        got, want = (np.asarray(x, np.float32) for x in (got, want))
        np.testing.assert_allclose(got, want, atol=tolerance * np.abs(want).max())


def by_frame(qkv: jax.Array, scale: float) -> jax.Array:
    """The CPU's way, whatever the size of a frame."""
    return cpu._by_frame(qkv, scale)


def interpreted_splash(qkv: jax.Array, scale: float) -> jax.Array:
    return splash.within(qkv, scale, interpret=True)


TOLERANCE = {"float32": 2e-5, "bfloat16": 2e-2}


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize(
    "within, shape",
    [(by_frame, (2, 3, 7, 3, 2, 5)), (by_frame, (1, 1, 9, 3, 3, 4)), (interpreted_splash, (1, 2, 140, 3, 2, 8))],
    ids=["cpu", "cpu-odd-heads", "splash"],
)
def test_attention_within_frames_is_plain_attention(within, shape: tuple, dtype: str):
    qkv = drawn(0, *shape, dtype=dtype)
    check_equal(lambda x: within(x, SCALE), lambda x: plain.within(x, SCALE), qkv, tolerance=TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("frames", [1, 2])
def test_attention_of_one_frame_over_a_cache_is_plain_attention(frames: int, dtype: str):
    qkv, keys, values = drawn(0, 2, frames, 4, 3, 2, 8, dtype=dtype), *drawn(1, 2, 2, 5, 4, 2, 8, dtype=dtype)
    visible = np.random.default_rng(3).random((frames, 5 + frames)) < 0.6
    visible[:, -1] = True
    check_equal(
        lambda *a: cpu.over_cache(*a, visible, SCALE),
        lambda *a: plain.over_cache(*a, visible, SCALE),
        qkv, keys, values, tolerance=TOLERANCE[dtype],
    )  # fmt: skip


def test_cudnn_is_given_frames_as_sequences(monkeypatch):
    """Where there is no such GPU, XLA's implementation of the same call stands in for the kernel."""
    calls = []
    real = jax.nn.dot_product_attention

    def stand_in(q, k, v, *, scale, implementation):
        calls.append((q.shape, implementation))
        return real(q, k, v, scale=scale, implementation="xla")

    monkeypatch.setattr(jax.nn, "dot_product_attention", stand_in)
    qkv = drawn(0, 2, 3, 6, 3, 2, 8, dtype=jnp.bfloat16)
    check_equal(lambda x: cudnn.within(x, SCALE), lambda x: plain.within(x, SCALE), qkv, tolerance=2e-2)
    assert calls == [((6, 6, 2, 8), "cudnn")]
    cudnn.within(qkv.astype(jnp.float32), SCALE)
    assert len(calls) == 1, "cuDNN has no kernel for float32"


@pytest.mark.skipif(jax.default_backend() != "gpu", reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("shape", [(2, 3, 320, 3, 8, 32), (1, 12, 68, 3, 2, 32)])
def test_cudnn_on_a_gpu_is_plain_attention(shape: tuple):
    qkv = drawn(0, *shape, dtype=jnp.bfloat16)
    check_equal(lambda x: cudnn.within(x, SCALE), lambda x: plain.within(x, SCALE), qkv, tolerance=2e-2)


def lowered_for_tpu(within) -> str:
    qkv = jax.ShapeDtypeStruct((2, 3, 320, 3, 8, 32), jnp.bfloat16)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(within(x, SCALE).astype(jnp.float32))))
    return gradient.trace(qkv).lower(lowering_platforms=("tpu",)).as_text()


def test_on_a_tpu_no_array_of_attention_weights_is_made():
    text = lowered_for_tpu(splash.within)
    assert text.count("tpu_custom_call") == 3, "forward pass, gradient of queries, gradient of keys and values"
    assert "320x320" not in text
    assert "320x320xf32" in lowered_for_tpu(plain.within)


@pytest.mark.parametrize(("platform", "own"), [("cpu", "cpu"), ("gpu", "cudnn"), ("tpu", "splash"), ("metal", "plain")])
def test_every_backend_on_offer_is_known_where_it_runs_and_another_is_refused(platform, own, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    for name in ("plain", "cpu", own):
        assert attention.find_backend(name) is attention.BACKENDS[name]
    assert attention.find_backend("auto") is attention.BACKENDS[own]
    with pytest.raises(ConfigError, match="'flash' is unknown"):
        attention.find_backend("flash")
    for name, where in {"cudnn": "an NVIDIA GPU", "splash": "a TPU"}.items():
        if name != own:
            message = f"attention '{name}' runs only on {where}, but the device is a {platform.upper()}; use auto"
            with pytest.raises(ConfigError, match=message):
                attention.find_backend(name)


def test_the_backend_is_that_of_the_devices_that_are_compiled_for(monkeypatch):
    """`hma plan` compiles for others than the default one."""
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    with jax.set_mesh(jax.make_mesh((1,), ("data",), devices=jax.devices("cpu")[:1])):
        found = []
        jax.jit(lambda x: found.append(attention.find_backend("auto")) or x)(0.0)
    assert found == [attention.BACKENDS["cpu"]]


def test_large_frames_attend_one_by_one_on_cpu_and_say_the_same():
    config = model_config(width=16, layers=1, tokens=260, action_tokens=4)
    batch, (_, params) = random_batch(0, config, 2), lively_params(config)
    predictions = []
    for how in ("cpu", "plain"):
        declared = declare_model(config, TABLE, ExecutionConfig(attention=how))
        look = jax.jit(
            lambda p, d=declared: d.merge(p)(batch["tokens"], None, batch["actions"], batch["embodiment"]).token_outputs
        )
        predictions.append(np.asarray(look(params)))
    np.testing.assert_allclose(*predictions, atol=1e-4 * np.abs(predictions[1]).max())
