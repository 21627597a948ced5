"""Metric definitions: image similarity, token likelihood, and means with standard errors.

Owns what a number means. It knows neither models nor datasets: `evaluation.protocol` decides
which images and logits are compared, and over which windows they are averaged.

`psnr` and `ssim` are pure and follow their input's array library: jax arrays are computed in
float32 (inside a jit, say), numpy arrays in float64. The evaluation gives them numpy arrays:
one float32 step at 29 dB is already 2e-6 dB, and delta PSNR is a small difference of such
numbers.

Reference: paper section 4 (Metrics); Wang et al. 2004 for SSIM, with the choices of
scikit-image (uniform window, sample covariance, borders cropped).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import require

MAX_PSNR = 100.0
"""dB given to identical images, whose PSNR would be infinite and spoil every mean."""

SSIM_WINDOW = 7

# --- Images ----------------------------------------------------------------------------------


def psnr(a: Any, b: Any) -> Any:
    """Peak signal-to-noise ratio in dB of images [..., H, W, C] in 0..255; returns [...].

    The squared error is averaged over pixels and channels together. DIFFERS: identical images
    score `MAX_PSNR` instead of infinity.
    """
    xp, a, b = _unit_images(a, b)
    error = xp.mean((a - b) ** 2, axis=(-3, -2, -1))
    return -10.0 * xp.log10(xp.maximum(error, 10.0 ** (-MAX_PSNR / 10.0)))


def ssim(a: Any, b: Any) -> Any:
    """Structural similarity of images [..., H, W, C] in 0..255; returns [...].

    7x7 uniform window, sample (n - 1) covariance, windows that lie wholly inside the image
    only, mean over positions and channels. Raises ConfigError for images below 7x7.
    """
    xp, a, b = _unit_images(a, b)
    require(
        min(a.shape[-3:-1]) >= SSIM_WINDOW,
        f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, got {a.shape[-3:-1]}",
    )
    # Covariances do not depend on the origin; near zero they lose fewer float32 digits.
    a, b = a - 0.5, b - 0.5
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    pixels = SSIM_WINDOW**2
    sample = pixels / (pixels - 1)
    var_a = sample * (_window_mean(a * a) - mean_a**2)
    var_b = sample * (_window_mean(b * b) - mean_b**2)
    covariance = sample * (_window_mean(a * b) - mean_a * mean_b)
    mean_a, mean_b = mean_a + 0.5, mean_b + 0.5
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (var_a + var_b + c2)
    return xp.mean(luminance * structure, axis=(-3, -2, -1))


def _unit_images(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """(array library, a, b) with both images as floats in 0..1."""
    require(a.shape == b.shape, f"images to compare differ in shape: {a.shape} and {b.shape}")
    xp = jnp if isinstance(a, jax.Array) or isinstance(b, jax.Array) else np
    dtype = jnp.float32 if xp is jnp else np.float64
    return xp, xp.asarray(a, dtype) / 255.0, xp.asarray(b, dtype) / 255.0


def _window_mean(x: Any) -> Any:
    """Mean over every SSIM_WINDOW^2 window inside [..., H, W, C], one axis after the other."""
    h, w = x.shape[-3] - SSIM_WINDOW + 1, x.shape[-2] - SSIM_WINDOW + 1
    rows = sum(x[..., i : i + h, :, :] for i in range(SSIM_WINDOW))
    return sum(rows[..., :, i : i + w, :] for i in range(SSIM_WINDOW)) / SSIM_WINDOW**2


# --- Tokens ----------------------------------------------------------------------------------


def factored_cross_entropy(logits: jax.Array, labels: jax.Array) -> jax.Array:
    """Nats per token: logits [..., Q, V] against token ids [...]; returns [...] in float32.

    An id is sum_q label_q V^q, factor 0 in the low digits. The factors' cross-entropies are
    summed, so exp of the result is per token of the full vocabulary V^Q. No smoothing.
    """
    factors, vocab = logits.shape[-2:]
    digits = labels[..., None] // vocab ** jnp.arange(factors) % vocab
    log_p = jax.nn.log_softmax(logits.astype(jnp.float32), axis=-1)
    return -jnp.take_along_axis(log_p, digits[..., None], axis=-1)[..., 0].sum(-1)


# --- Averages --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stat:
    """A mean with its standard error over `n` independent values (nan when n is 1)."""

    mean: float
    sem: float
    n: int


def mean_and_sem(values: Any, weights: Any = None) -> Stat:
    """Mean and standard error of a 1-D collection, optionally weighted."""
    x = np.asarray(values, np.float64).ravel()
    w = np.ones_like(x) if weights is None else np.asarray(weights, np.float64).ravel()
    require(len(x) > 0, "no values to average")
    require(len(x) == len(w), f"{len(x)} values but {len(w)} weights")
    w = w / w.sum()
    mean = float(w @ x)
    if len(x) == 1:
        return Stat(mean, math.nan, 1)
    variance = (w**2 @ (x - mean) ** 2) * len(x) / (len(x) - 1)
    return Stat(mean, math.sqrt(variance), len(x))


def stratified(stats: Iterable[Stat]) -> Stat:
    """Mean over datasets, every dataset counting equally: sem = sqrt(sum sem^2) / D.

    The datasets are fixed, not a sample of possible datasets: only the windows drawn within
    each contribute error. A dataset of one window cannot know its own error; it is taken to
    scatter as the windows of the others do on average. `n` counts the windows of all.
    """
    stats = list(stats)
    require(len(stats) > 0, "no datasets to average over")
    known = [s.sem**2 * s.n for s in stats if not math.isnan(s.sem)]  # variance of one window
    typical = sum(known) / len(known) if known else math.nan
    squares = [typical / s.n if math.isnan(s.sem) else s.sem**2 for s in stats]
    return Stat(
        mean=sum(s.mean for s in stats) / len(stats),
        sem=math.sqrt(sum(squares)) / len(stats),
        n=sum(s.n for s in stats),
    )


def group_means(values: Any, group: int) -> tuple[np.ndarray, np.ndarray]:
    """(means, sizes) of consecutive groups of `group` values; the last may be smaller."""
    x = np.asarray(values, np.float64).ravel()
    starts = np.arange(0, len(x), group)
    sizes = np.diff(np.append(starts, len(x)))
    return np.add.reduceat(x, starts) / sizes, sizes


def official_perplexity(batch_losses: Sequence[float] | np.ndarray, batch_sizes: Any) -> float:
    """Size-weighted mean over batches of exp(mean loss of the batch), as the release reports it.

    A mean of exponentials, so by Jensen it lies above `corpus_perplexity` and grows as batches
    shrink: comparable only at one batch size and one tokenizer.
    """
    return float(np.average(np.exp(np.asarray(batch_losses, np.float64)), weights=batch_sizes))


def perplexity(losses: Any, group: int) -> Stat:
    """`official_perplexity` of windows in batches of `group`; standard error over windows.

    The error is the delta method's, value times that of the mean loss: a dataset may hold too
    few batches to estimate one from their scatter.
    """
    value, stat = official_perplexity(*group_means(losses, group)), mean_and_sem(losses)
    return Stat(value, value * stat.sem, stat.n)


def corpus_perplexity(losses: Any) -> Stat:
    """exp of the mean loss over all windows (infinite beyond what a float holds); standard error by
    the delta method."""
    stat = mean_and_sem(losses)
    with np.errstate(over="ignore"):
        value = float(np.exp(stat.mean))
    return Stat(value, value * stat.sem, stat.n)
