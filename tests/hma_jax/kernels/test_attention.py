"""Every backend of attention has the values and the gradients of the plain one."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.config.execution import Attention
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


class OwnWay(NamedTuple):
    """For which arguments a backend takes a way of its own within frames, and what is patched so that it does here."""

    patched: Callable[[pytest.MonkeyPatch], None]
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[str, ...] = ("float32", "bfloat16")


def interpret_splash(patch: pytest.MonkeyPatch) -> None:
    attend = splash._attend
    patch.setattr(splash, "_attend", lambda qkv, scale: attend(qkv, scale, interpret=True))


def stand_in_for_cudnn(patch: pytest.MonkeyPatch) -> None:
    """XLA's implementation of the same call."""
    real = jax.nn.dot_product_attention
    patch.setattr(jax.nn, "dot_product_attention", lambda *qkv, **how: real(*qkv, **how | {"implementation": "xla"}))


OWN_WAYS = {
    "cpu": OwnWay(lambda patch: patch.setattr(cpu, "CACHED_BYTES", 0), ((2, 3, 7, 3, 2, 5), (1, 1, 9, 3, 3, 4))),
    "cudnn": OwnWay(stand_in_for_cudnn, ((2, 3, 6, 3, 2, 8),), ("bfloat16",)),
    "splash": OwnWay(interpret_splash, ((1, 2, 140, 3, 2, 8),)),
}
PLAIN = attention.BACKENDS["plain"]
TOLERANCE = {"float32": 2e-5, "bfloat16": 2e-2}


def own(part: str) -> list[str]:
    """The backends whose function `part` is not that of `plain`."""
    return [name for name, backend in attention.BACKENDS.items() if getattr(backend, part) is not getattr(PLAIN, part)]


def test_every_name_is_a_backend_that_is_tested_here():
    assert set(get_args(Attention)) == {"auto", *attention.BACKENDS}, "add yours to both"
    assert own("within") == list(OWN_WAYS), "add yours to OWN_WAYS"


@pytest.mark.parametrize(
    "name, shape, dtype",
    [(name, shape, dtype) for name, way in OWN_WAYS.items() for shape in way.shapes for dtype in way.dtypes],
)
def test_attention_within_frames_is_plain_attention(name: str, shape: tuple, dtype: str, monkeypatch):
    OWN_WAYS[name].patched(monkeypatch)
    monkeypatch.setattr(plain, "within", None)  # what a backend leaves to `plain` is not its own
    qkv, within = drawn(0, *shape, dtype=dtype), attention.BACKENDS[name].within
    check_equal(lambda x: within(x, SCALE), lambda x: PLAIN.within(x, SCALE), qkv, tolerance=TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("part, name", [(part, name) for part in ("over_time", "over_cache") for name in own(part)])
def test_attention_over_time_is_plain_attention(part: str, name: str, frames: int, dtype: str):
    args, past = [drawn(0, 2, frames, 4, 3, 2, 8, dtype=dtype)], 0
    if part == "over_cache":
        past = 5
        args.extend(drawn(1, 2, 2, past, 4, 2, 8, dtype=dtype))  # keys and values
    visible = np.random.default_rng(3).random((frames, past + frames)) < 0.6
    visible[:, -1] = True
    ours, theirs = (getattr(backend, part) for backend in (attention.BACKENDS[name], PLAIN))
    check_equal(
        lambda *a: ours(*a, visible, SCALE), lambda *a: theirs(*a, visible, SCALE), *args, tolerance=TOLERANCE[dtype]
    )


def test_cudnn_is_given_frames_as_sequences(monkeypatch):
    calls = []

    def stand_in(q, k, v, *, scale, implementation):
        calls.append((q.shape, implementation))
        return q

    monkeypatch.setattr(jax.nn, "dot_product_attention", stand_in)
    qkv = drawn(0, 2, 3, 6, 3, 2, 8, dtype=jnp.bfloat16)
    cudnn.within(qkv, SCALE)
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
    monkeypatch.setattr(attention, "default_device", lambda: SimpleNamespace(platform=platform))
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
    monkeypatch.setattr(attention, "default_device", lambda: SimpleNamespace(platform="tpu"))
    with jax.set_mesh(jax.make_mesh((1,), ("data",), devices=jax.devices("cpu")[:1])):
        found = []
        jax.jit(lambda x: found.append(attention.find_backend("auto")) or x)(0.0)
    assert found == [attention.BACKENDS["cpu"]]


@pytest.mark.parametrize("platform", ["gpu", "tpu"])
def test_the_backend_is_that_of_the_default_device_and_not_of_the_fastest(platform: str, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)  # as where there is one
    for device in ("cpu", jax.devices("cpu")[0]):
        with jax.default_device(device):
            assert attention.find_backend("auto") is attention.BACKENDS["cpu"]


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
