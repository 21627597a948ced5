"""Metrics against vectors made with scikit-image and the official cross-entropy."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.evaluation import metrics
from hma_jax.model.frames import factorise

GOLDEN = Path(__file__).parents[2] / "golden" / "12_metrics"


@pytest.fixture(scope="module")
def golden():
    """(inputs with images as [..., H, W, C], expected outputs)."""
    with np.load(GOLDEN / "inputs.npz") as file:
        inputs = dict(file)
    for name in ("ground_truth", "predicted", "predicted_random_actions"):
        inputs[name] = np.moveaxis(inputs[name], -3, -1)
    return inputs, json.loads((GOLDEN / "outputs.json").read_text())


def test_psnr_equals_golden_per_frame_and_per_clip(golden):
    x, expected = golden
    true, predicted = x["ground_truth"], x["predicted"]
    np.testing.assert_allclose(metrics.psnr(true, predicted), expected["psnr_per_frame"], rtol=0, atol=1e-6)
    clip = (true.shape[0], -1, *true.shape[3:])  # a clip as one tall image
    whole = metrics.psnr(true.reshape(clip), predicted.reshape(clip))
    np.testing.assert_allclose(whole, expected["psnr_whole_clip"], rtol=0, atol=1e-6)


def test_delta_psnr_equals_golden(golden):
    x, expected = golden
    last = x["ground_truth"][:, -1]
    random = metrics.psnr(np.broadcast_to(last, (5, *last.shape)), x["predicted_random_actions"][:, :, -1])
    delta = metrics.psnr(last, x["predicted"][:, -1]) - random.mean(0)
    np.testing.assert_allclose(delta, expected["delta_psnr_per_clip"], rtol=0, atol=1e-6)


def test_ssim_equals_golden(golden):
    x, expected = golden
    ssim = metrics.ssim(x["ground_truth"], x["predicted"])
    np.testing.assert_allclose(ssim, expected["ssim_per_frame"], rtol=0, atol=1e-6)


def test_cross_entropy_perplexity_and_accuracy_equal_golden(golden):
    x, expected = golden
    logits = np.moveaxis(x["factored_logits"], (1, 2), (-1, -2))  # [B, T-1, h, w, Q, V]
    labels = x["labels"].reshape(2, 4, 4, 4)[:, 1:]
    mean = float(metrics.factored_cross_entropy(jnp.asarray(logits), jnp.asarray(labels)).mean())
    assert mean == pytest.approx(expected["cross_entropy"], abs=1e-5)
    assert math.exp(mean) == pytest.approx(expected["perplexity"], rel=1e-5)
    assert (x["samples"] == labels).mean() == expected["token_accuracy"]


def test_perplexity_is_the_size_weighted_mean_of_exponentials(golden):
    x, expected = golden
    value = metrics.official_perplexity(x["batch_losses"], x["batch_sizes"])
    assert value == pytest.approx(expected["mean_perplexity_over_batches"], abs=1e-6)
    pooled = np.average(x["batch_losses"], weights=x["batch_sizes"])
    assert value > math.exp(pooled)  # a mean of exponentials lies above exp of the mean


def test_identical_images_have_finite_psnr_and_ssim_one():
    image = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    assert metrics.psnr(image, image) == metrics.MAX_PSNR
    assert metrics.ssim(image, image) == pytest.approx(1.0)


def test_uniform_logits_have_the_vocabulary_as_perplexity():
    loss = metrics.factored_cross_entropy(jnp.zeros((5, 2, 16)), jnp.arange(5) * 50)
    np.testing.assert_allclose(np.exp(loss), 256.0, rtol=1e-5)


def test_factor_zero_is_the_low_digit():
    logits = jnp.full((1, 2, 8), -100.0).at[0, 0, 3].set(0.0).at[0, 1, 5].set(0.0)
    assert metrics.factored_cross_entropy(logits, jnp.array([3 + 5 * 8]))[0] < 1e-5
    assert metrics.factored_cross_entropy(logits, jnp.array([5 + 3 * 8]))[0] > 100


def test_padding_is_part_of_no_mean_and_no_last_frame():
    x = jnp.asarray([[[1.0, 3.0], [5.0, 7.0], [99.0, 99.0]], [[0.0, 2.0], [4.0, 6.0], [8.0, 10.0]]])
    real = jnp.asarray([[True, True, False], [True, True, True]])
    assert metrics.mean_over_frames(x, real).tolist() == [4, 5]
    assert metrics.mean_over_frames(x, None).tolist() == pytest.approx([214 / 6, 5])
    assert metrics.last_frames(x, real).tolist() == [[5, 7], [8, 10]]
    assert metrics.last_frames(x, None).tolist() == [[99, 99], [8, 10]]
    assert metrics.last_frames(x[:, None], real, axis=2).tolist() == [[[5, 7]], [[8, 10]]]


def test_images_that_cannot_be_compared_are_refused():
    image = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ConfigError, match="differ in shape"):
        metrics.psnr(image, image[:, 1:])
    with pytest.raises(ConfigError, match="must be uint8, got uint8 and float64"):
        metrics.psnr(image, image / 255)
    with pytest.raises(ConfigError, match="at least 7x7"):
        metrics.ssim(image[:4], image[:4])
    for metric in (metrics.psnr, metrics.ssim):
        with pytest.raises(ConfigError, match=r"have height, width and channels, got \(8, 8\)"):
            metric(image[..., 0], image[..., 0])
    with pytest.raises(ConfigError, match="rows of up to 33025 values"):
        metrics.psnr(np.zeros((1, 11_009, 3), np.uint8), np.zeros((1, 11_009, 3), np.uint8))


def ssim_in_float64(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """As scikit-image has it, of images [n, H, W, C] in 0..1: every window's own mean and covariance."""

    def windows(x):
        return np.lib.stride_tricks.sliding_window_view(x, (7, 7), axis=(1, 2))

    a, b = windows(a), windows(b)
    mean_a, mean_b = a.mean((-1, -2)), b.mean((-1, -2))
    da, db = a - mean_a[..., None, None], b - mean_b[..., None, None]
    var_a, var_b, both = ((x * y).sum((-1, -2)) / 48 for x, y in ((da, da), (db, db), (da, db)))
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * mean_a * mean_b + c1) * (2 * both + c2)
    return (values / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean((1, 2, 3))


GREY_LEVELS = np.array([0, 0, 1, 4, 16, 64, 300]).reshape(-1, 1, 1, 1)
"""Of noise; what comes out is clipped to 0..255."""


@pytest.mark.parametrize("size", [(7, 7, 3), (8, 9, 1), (31, 57, 3), (256, 256, 3), (7, 3600, 3)], ids=str)
def test_numbers_on_the_device_are_those_of_float64(size):
    rng = np.random.default_rng(0)
    a = rng.integers(0, 256, (len(GREY_LEVELS), *size)).astype(np.uint8)
    b = np.clip(np.round(a + GREY_LEVELS * rng.standard_normal(a.shape)), 0, 255).astype(np.uint8)
    b[1, 0, 0, 0] ^= 1  # one grey level in one place: the highest PSNR below that of identical images
    error = ((a / 255 - b / 255) ** 2).mean((-3, -2, -1))
    psnr = -10 * np.log10(np.maximum(error, 1e-10))
    few = slice(None) if a.size < 1e6 else slice(2, 4)  # every window by itself takes 49 times the memory
    ssim = ssim_in_float64(a[few] / 255, b[few] / 255)
    np.testing.assert_allclose(metrics.psnr(a, b), psnr, rtol=0, atol=1e-11)
    np.testing.assert_allclose(metrics.ssim(a, b)[few], ssim, rtol=0, atol=1e-11)
    on_device = jax.jit(lambda a, b: (metrics.psnr(a, b), metrics.ssim(a, b)))(a, b)
    assert {x.dtype for x in on_device} == {jnp.dtype("float32")}
    np.testing.assert_allclose(on_device[0], psnr, rtol=0, atol=1e-5)
    np.testing.assert_allclose(on_device[1][few], ssim, rtol=0, atol=1e-6)


def test_ssim_of_bright_and_almost_even_images_keeps_its_digits_on_the_device():
    """Variances are small differences of large sums."""
    a, b = np.random.default_rng(0).integers(250, 253, (2, 3, 12, 16, 3)).astype(np.uint8)
    found = jax.jit(metrics.ssim)(a, b)
    np.testing.assert_allclose(found, ssim_in_float64(a / 255, b / 255), rtol=0, atol=1e-6)


def test_ids_are_taken_apart_as_the_model_takes_them_apart():
    ids = jnp.arange(6**3)
    certain = jax.nn.one_hot(factorise(ids, 3, 6), 6) * 200.0
    np.testing.assert_allclose(metrics.factored_cross_entropy(certain, ids), 0, atol=1e-6)


def test_grouping_keeps_a_smaller_last_group():
    means, sizes = metrics.group_means([1.0, 3.0, 5.0, 7.0, 9.0], 2)
    np.testing.assert_array_equal(means, [2.0, 6.0, 9.0])
    np.testing.assert_array_equal(sizes, [2, 2, 1])
