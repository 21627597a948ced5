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

GOLDEN = Path(__file__).parents[1] / "golden" / "12_metrics"


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


def test_jax_inputs_give_the_same_images_metrics_inside_jit(golden):
    true, predicted = golden[0]["ground_truth"], golden[0]["predicted"]
    for metric, atol in ((metrics.psnr, 2e-5), (metrics.ssim, 2e-5)):
        on_device = jax.jit(metric)(true, predicted)
        assert on_device.dtype == jnp.float32
        np.testing.assert_allclose(on_device, metric(true, predicted), rtol=0, atol=atol)


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


def test_standard_error_shrinks_with_the_root_of_n():
    values = np.random.default_rng(1).normal(3.0, 2.0, 10_000)
    stat = metrics.mean_and_sem(values)
    assert stat.n == 10_000 and stat.sem == pytest.approx(2.0 / 100, rel=0.05)
    assert stat.mean == pytest.approx(3.0, abs=4 * stat.sem)
    weighted = metrics.mean_and_sem(values, np.full(len(values), 7.0))
    assert weighted.mean == pytest.approx(stat.mean) and weighted.sem == pytest.approx(stat.sem)


def test_one_value_has_an_unknown_error_not_zero():
    assert math.isnan(metrics.mean_and_sem([2.0]).sem)


def test_stratified_mean_weighs_datasets_equally_and_combines_errors():
    stats = [metrics.Stat(1.0, 0.3, 10), metrics.Stat(3.0, 0.4, 1000)]
    assert metrics.stratified(stats) == metrics.Stat(2.0, pytest.approx(0.25), 1010)


def test_a_dataset_of_one_window_takes_the_scatter_of_the_others():
    stats = [metrics.Stat(1.0, 0.5, 4), metrics.Stat(3.0, math.nan, 1)]
    assert metrics.stratified(stats).sem == pytest.approx(math.sqrt(0.5**2 + 1.0**2) / 2)
    assert math.isnan(metrics.stratified(stats[1:]).sem)


def test_grouping_keeps_a_smaller_last_group():
    means, sizes = metrics.group_means([1.0, 3.0, 5.0, 7.0, 9.0], 2)
    np.testing.assert_array_equal(means, [2.0, 6.0, 9.0])
    np.testing.assert_array_equal(sizes, [2, 2, 1])


def test_perplexity_has_an_error_even_when_all_windows_form_one_group():
    losses = [1.0, 1.2, 0.8]
    one, many = metrics.perplexity(losses, 4), metrics.perplexity(losses, 1)
    assert one.mean == pytest.approx(math.e) and one.n == 3
    assert one.sem == pytest.approx(metrics.corpus_perplexity(losses).sem)
    assert many.mean > one.mean


def test_corpus_perplexity_error_is_the_delta_method():
    stat = metrics.corpus_perplexity([1.0, 1.2, 0.8])
    assert stat.mean == pytest.approx(math.e)
    assert stat.sem == pytest.approx(math.e * metrics.mean_and_sem([1.0, 1.2, 0.8]).sem)


def test_shapes_that_differ_and_empty_averages_are_refused():
    with pytest.raises(ConfigError, match="differ in shape"):
        metrics.psnr(np.zeros((8, 8, 3)), np.zeros((8, 9, 3)))
    with pytest.raises(ConfigError, match="at least 7x7"):
        metrics.ssim(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)))
    with pytest.raises(ConfigError, match="no values"):
        metrics.mean_and_sem([])


def test_a_model_that_is_certain_and_wrong_has_an_infinite_perplexity():
    assert metrics.corpus_perplexity(np.array([700.0, 800.0])).mean == np.inf
