"""Metric definitions: image similarity and token likelihood.

This module defines what a number means for one image or one token. `protocol` and `images` decide which images and
logits are compared; averages and their errors are in `statistics`.

`psnr` and `ssim` take integers and use their input's array library. Sums over pixels are exact integers in both
libraries; only later steps are rounded, to float32 for JAX arrays (inside a jit, say) and to float64 for NumPy arrays.
On devices PSNR is within 1e-5 dB of float64, SSIM within 1e-5.

Reference: paper section 4 (Metrics); Wang et al. 2004 for SSIM, with the choices of
scikit-image (uniform window, sample covariance, borders cropped).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import require
from hma_jax.model.frames import factorise

PEAK = 255
"""The largest value of a pixel."""

MAX_PSNR = 100.0
"""PSNR, in dB, of identical images: otherwise it would be infinite, and so would every mean."""

SSIM_WINDOW = 7

MAX_ROW_VALUES, MAX_ROWS = (2**31 - 1) // PEAK**2, 2**15
"""Values in a row of pixels, and rows, whose squared errors still add up in an int32 (`psnr`)."""

# --- Images ----------------------------------------------------------------------------------


def psnr(a: Any, b: Any) -> Any:
    """Peak signal-to-noise ratio in dB of uint8 images [..., H, W, C]; returns [...].

    The squared error is averaged over pixels and channels together. DIFFERS: identical images
    score `MAX_PSNR` instead of infinity. Raises ConfigError for images that cannot be compared.
    """
    xp, a, b = _whole_numbers(a, b)
    height, width, channels = a.shape[-3:]
    require(
        height <= MAX_ROWS and width * channels <= MAX_ROW_VALUES,
        f"PSNR takes images of up to {MAX_ROWS} rows of up to {MAX_ROW_VALUES} values, got {a.shape[-3:]}",
    )
    rows = xp.sum((a - b) ** 2, axis=(-2, -1))
    # The sum over rows may exceed an int32, its halves do not.
    high, low = xp.sum(rows >> 16, axis=-1), xp.sum(rows & 0xFFFF, axis=-1)
    error = (_float(xp, high) * 2.0**16 + _float(xp, low)) / float(height * width * channels * PEAK**2)
    # The logarithm of a number near 1 has a small absolute error; the exponent of 2 has none.
    mantissa, exponent = xp.frexp(xp.maximum(error, 10.0 ** (-MAX_PSNR / 10.0)))
    return -10.0 * (xp.log10(mantissa) + math.log10(2.0) * exponent)


def difference(a: jax.Array, b: jax.Array) -> jax.Array:
    """a - b, elementwise; exactly 0 where they are equal. A compiler may fuse the last product in one of them with the
    subtraction (FMA); the difference of equal numbers would then be the rounding error of that product."""
    return jnp.where(a == b, 0, a - b)


def ssim(a: Any, b: Any) -> Any:
    """Structural similarity of uint8 images [..., H, W, C]; returns [...].

    7x7 uniform window, sample (n - 1) covariance, only windows that lie wholly inside the image, mean over positions
    and channels. Raises ConfigError for images below 7x7.
    """
    xp, a, b = _whole_numbers(a, b)
    require(
        min(a.shape[-3:-1]) >= SSIM_WINDOW,
        f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, got {a.shape[-3:-1]}",
    )
    n = SSIM_WINDOW**2
    # Sums over a window of pixels and of products, below 2^29: all of this is exact.
    sum_a, sum_b = _window_sum(a), _window_sum(b)
    means, squared_means = sum_a * sum_b, sum_a**2 + sum_b**2  # times n^2
    covariance = n * _window_sum(a * b) - means  # times n (n - 1), like the variances
    variances = n * _window_sum(a * a + b * b) - squared_means
    c1, c2 = (0.01 * PEAK * n) ** 2, (0.03 * PEAK) ** 2 * n * (n - 1)
    luminance = (_float(xp, 2 * means) + c1) / (_float(xp, squared_means) + c1)
    structure = (_float(xp, 2 * covariance) + c2) / (_float(xp, variances) + c2)
    # One axis after the other: a float32 sum over all positions at once would lose digits.
    return xp.mean(xp.mean(luminance * structure, axis=(-2, -1)), axis=-1)


def _whole_numbers(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """(array library, a, b) with both images as int32."""
    require(a.shape == b.shape, f"images to compare differ in shape: {a.shape} and {b.shape}")
    require(a.ndim >= 3, f"images to compare must have height, width and channels, got {a.shape}")
    require(a.dtype == b.dtype == np.uint8, f"images to compare must be uint8, got {a.dtype} and {b.dtype}")
    xp = jnp if isinstance(a, jax.Array) or isinstance(b, jax.Array) else np
    return xp, xp.asarray(a, np.int32), xp.asarray(b, np.int32)


def _float(xp: Any, x: Any) -> Any:
    return x.astype(np.float32 if xp is jnp else np.float64)


def _window_sum(x: Any) -> Any:
    """Sum over every SSIM_WINDOW^2 window inside [..., H, W, C], one axis after the other."""
    h, w = x.shape[-3] - SSIM_WINDOW + 1, x.shape[-2] - SSIM_WINDOW + 1
    rows = sum(x[..., i : i + h, :, :] for i in range(SSIM_WINDOW))
    return sum(rows[..., :, i : i + w, :] for i in range(SSIM_WINDOW))


def mean_over_frames(x: jax.Array, real_BT: jax.Array | None) -> jax.Array:
    """[B, T, ...] -> [B], the mean over the frames that are `real_BT` (None: all are)."""
    if real_BT is None:
        return x.mean(tuple(range(1, x.ndim)))
    per_frame = x.mean(tuple(range(2, x.ndim)))
    return jnp.sum(jnp.where(real_BT, per_frame, 0), axis=1) / jnp.maximum(jnp.sum(real_BT, axis=1), 1)


def last_frames(x: jax.Array, real_BT: jax.Array | None, axis: int = 1) -> jax.Array:
    """[B, T, ...] -> [B, ...], each window's last frame that is `real_BT`; `axis` is that of the frames."""
    if real_BT is None:
        return jnp.take(x, x.shape[axis] - 1, axis=axis)
    last_B = jnp.sum(real_BT, axis=1) - 1  # padding stands at the end
    return jax.vmap(lambda one, last: jnp.take(one, last, axis=axis - 1))(x, last_B)


# --- Tokens ----------------------------------------------------------------------------------


def factored_cross_entropy(logits: jax.Array, labels: jax.Array) -> jax.Array:
    """Nats per token: logits [..., Q, V] against token ids [...]; returns [...] in float32.

    The factors' cross-entropies are summed, so exp of the result is per token of the full
    vocabulary V^Q. No smoothing.
    """
    digits = factorise(labels, *logits.shape[-2:])
    log_p = jax.nn.log_softmax(logits.astype(jnp.float32), axis=-1)
    return -jnp.take_along_axis(log_p, digits[..., None], axis=-1)[..., 0].sum(-1)


def group_means(values: Any, group: int) -> tuple[np.ndarray, np.ndarray]:
    """(means, sizes) of consecutive groups of `group` values; the last may be smaller."""
    x = np.asarray(values, np.float64).ravel()
    starts = np.arange(0, len(x), group)
    sizes = np.diff(np.append(starts, len(x)))
    return np.add.reduceat(x, starts) / sizes, sizes


def official_perplexity(batch_losses: Sequence[float] | np.ndarray, batch_sizes: Any) -> float:
    """Size-weighted mean over batches of exp(mean loss of the batch), as the release reports it.

    As a mean of exponentials it lies above the corpus perplexity (Jensen's inequality) and grows as batches shrink, so
    it is comparable only at the same batch size and with the same tokenizer.
    """
    return float(np.average(np.exp(np.asarray(batch_losses, np.float64)), weights=batch_sizes))
