"""Small networks on images, as functions of dictionaries of arrays: what policies and success heads share.

Frames are averaged down to `size` and become K points: where each of the last convolution's maps is strongest, by a
spatial softmax (Levine et al. 2016, "End-to-End Training of Deep Visuomotor Policies"), and how strong it is there. A
network that finds a mark at one place then finds it anywhere; a dense layer on the maps would have to learn every place
separately.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import require

Params = dict[str, Any]


STRIDED_LAYERS = 2
"""Number of convolutions with stride 2, which come first; those after them have stride 1."""

SHARPNESS = 3.0
"""Factor on a map's values before the softmax, at the beginning of training."""


@dataclass(frozen=True)
class EncoderConfig:
    """`size`: pixels of a side that the first convolution sees; `hidden`: width of the layers after the points."""

    size: int = 32
    channels: tuple[int, ...] = (16, 32, 32)
    hidden: int = 128

    def __post_init__(self):
        require(
            len(self.channels) >= STRIDED_LAYERS and self.size % 2**STRIDED_LAYERS == 0,
            f"an encoder needs {STRIDED_LAYERS} convolutions and a size that {2**STRIDED_LAYERS} divides, got {self.size}",
        )

    @property
    def features(self) -> int:
        """Number of values that `encode` gives for an image."""
        return 3 * self.channels[-1]


def init_dense(key: jax.Array, inputs: int, outputs: int, gain: float = 2.0) -> Params:
    return {
        "w": jax.random.normal(key, (inputs, outputs), jnp.float32) * math.sqrt(gain / inputs),
        "b": jnp.zeros(outputs, jnp.float32),
    }


def dense(params: Params, x: jax.Array) -> jax.Array:
    return x @ params["w"] + params["b"]


def init_mlp(key: jax.Array, widths: tuple[int, ...]) -> list[Params]:
    """Parameters of an MLP; the last layer starts small."""
    keys, last = jax.random.split(key, len(widths) - 1), len(widths) - 2
    return [init_dense(k, widths[i], widths[i + 1], 0.1 if i == last else 2.0) for i, k in enumerate(keys)]


def mlp(layers: list[Params], x: jax.Array) -> jax.Array:
    for layer in layers[:-1]:
        x = jax.nn.relu(dense(layer, x))
    return dense(layers[-1], x)


def init_encoder(key: jax.Array, config: EncoderConfig, inputs: int) -> Params:
    """Parameters of an encoder for images with `inputs` channels."""
    widths, kernels = (inputs, *config.channels), (5, *(3,) * (len(config.channels) - 1))
    keys = jax.random.split(key, len(kernels))
    convolutions = [
        {
            "w": jax.random.normal(k, (side, side, widths[i], widths[i + 1]), jnp.float32)
            * math.sqrt(2 / (side * side * widths[i])),
            "b": jnp.zeros(widths[i + 1], jnp.float32),
        }
        for i, (k, side) in enumerate(zip(keys, kernels, strict=True))
    ]
    return {"convolutions": convolutions, "sharpness": jnp.full(config.channels[-1], SHARPNESS, jnp.float32)}


def encode(params: Params, config: EncoderConfig, images: jax.Array) -> jax.Array:
    """Features [B, 3 K] of images [B, H, W, C] in [-1, 1]; H and W are multiples of `config.size`."""
    x = downsample(images, config.size)
    for i, layer in enumerate(params["convolutions"]):
        by = 2 if i < STRIDED_LAYERS else 1
        x = jax.nn.relu(x) if i else x
        x = jax.lax.conv_general_dilated(x, layer["w"], (by, by), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
        x = x + layer["b"]
    return spatial_softmax(x, params["sharpness"])


def spatial_softmax(maps: jax.Array, sharpness: jax.Array) -> jax.Array:
    """[B, 3 K] of maps [B, h, w, K]: mean column and row under a softmax of each map, and its mean under it."""
    batch, height, width, count = maps.shape
    flat = maps.reshape(batch, height * width, count)
    weight = jax.nn.softmax(flat * sharpness, axis=1)
    sides = (jnp.linspace(-1, 1, n, dtype=maps.dtype) for n in (height, width))
    rows, columns = jnp.meshgrid(*sides, indexing="ij")
    x, y = (jnp.einsum("bpk,p->bk", weight, at.ravel()) for at in (columns, rows))
    return jnp.concatenate([x, y, jnp.tanh((weight * flat).sum(1) / 4)], -1)


def require_images(images: np.ndarray, batch: bool = False) -> None:
    """Raises ConfigError unless these are images uint8 [..., H, W, 3], or, as a `batch`, [B, H, W, 3]. Those in 0..1
    would look black."""
    shape = "[B, H, W, 3]" if batch else "[..., H, W, 3]"
    require(
        images.dtype == np.uint8 and images.ndim >= 3 and images.shape[-1] == 3 and images.size > 0
        and (images.ndim == 4 or not batch),
        f"policies and success heads need images uint8 {shape}, got {images.dtype} {list(images.shape)}",
    )  # fmt: skip


def require_multiples(height: int, width: int, size: int) -> None:
    """Raises ConfigError for images that cannot be averaged down to `size`."""
    require(
        height % size == 0 == width % size,
        f"policies and success heads need images of {size} x {size} pixels, but {height} x {width} is not a multiple "
        "of this; use a model with other frames",
    )


def downsample(images: jax.Array, size: int) -> jax.Array:
    """[B, size, size, C]: means over square blocks of pixels. Raises ConfigError if the sizes do not divide."""
    batch, height, width, channels = images.shape
    require_multiples(height, width, size)
    if (height, width) == (size, size):
        return images
    return images.reshape(batch, size, height // size, size, width // size, channels).mean((2, 4))


def downsample_uint8(images: np.ndarray, size: int) -> np.ndarray:
    """`downsample` of uint8 images [..., H, W, 3] in advance, rounded: training then moves fewer bytes."""
    height, width = images.shape[-3:-1]
    require_multiples(height, width, size)
    parts = images.reshape(*images.shape[:-3], size, height // size, size, width // size, images.shape[-1])
    return np.round(parts.mean((-4, -2), dtype=np.float32)).astype(np.uint8)


def jitter_colour(frames: jax.Array, key: jax.Array, strength: float) -> jax.Array:
    """Colour jitter: frames [B, n, H, W, 3] in [-1, 1] with a random gain and offset of each example's colours."""
    shape = (len(frames), 1, 1, 1, 3)
    gain, offset = strength * jax.random.normal(key, (2, *shape), frames.dtype)
    return frames * (1 + gain) + offset


def random_shift(frames: jax.Array, key: jax.Array, most: int) -> jax.Array:
    """Random shifts: frames [B, n, H, W, 3]; all n frames of an example are moved together by up to `most` pixels, and
    edges are repeated."""
    if not most:
        return frames
    wide = jnp.pad(frames, ((0, 0), (0, 0), (most, most), (most, most), (0, 0)), mode="edge")
    place = jax.random.randint(jax.random.fold_in(key, 1), (len(frames), 2), 0, 2 * most + 1, jnp.int32)
    start = jnp.pad(place, ((0, 0), (1, 1)))  # for all images and colours
    return jax.vmap(lambda x, at: jax.lax.dynamic_slice(x, at, frames.shape[1:]))(wide, start)


def as_floats(images: jax.Array) -> jax.Array:
    """uint8 [..., H, W, 3] to [-1, 1]."""
    return images.astype(jnp.float32) / 127.5 - 1


def stack_frames(frames: jax.Array) -> jax.Array:
    """The last n frames [B, n, H, W, 3] stacked along channels, [B, H, W, 3 n]: the newest, then its difference from
    each frame before it."""
    newest = frames[:, -1:]
    stacked = jnp.concatenate([newest, newest - frames[:, :-1]], 1)
    return jnp.moveaxis(stacked, 1, 3).reshape(*stacked.shape[:1], *stacked.shape[2:4], -1)
