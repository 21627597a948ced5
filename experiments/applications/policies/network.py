"""Small networks on images, as functions of dictionaries of arrays: what policies and success heads share.

Frames are averaged down to `size`; convolutions of stride 2 and a dense layer make features of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import require

Params = dict[str, Any]


@dataclass(frozen=True)
class EncoderConfig:
    """`size`: pixels of a side that the first convolution sees; each convolution halves it."""

    size: int = 32
    channels: tuple[int, ...] = (16, 32, 64)
    hidden: int = 128  # features, and the width of what follows

    def __post_init__(self):
        fold = 2 ** len(self.channels)
        require(
            len(self.channels) >= 1 and self.size % fold == 0,
            f"{len(self.channels)} convolutions of stride 2 need a size that {fold} divides, got {self.size}",
        )


def init_dense(key: jax.Array, inputs: int, outputs: int, gain: float = 2.0) -> Params:
    return {
        "w": jax.random.normal(key, (inputs, outputs)) * np.sqrt(gain / inputs),
        "b": jnp.zeros(outputs),
    }


def dense(params: Params, x: jax.Array) -> jax.Array:
    return x @ params["w"] + params["b"]


def init_mlp(key: jax.Array, widths: tuple[int, ...]) -> list[Params]:
    """The last layer begins small."""
    keys, last = jax.random.split(key, len(widths) - 1), len(widths) - 2
    return [init_dense(k, widths[i], widths[i + 1], 0.1 if i == last else 2.0) for i, k in enumerate(keys)]


def mlp(layers: list[Params], x: jax.Array) -> jax.Array:
    for layer in layers[:-1]:
        x = jax.nn.relu(dense(layer, x))
    return dense(layers[-1], x)


def init_encoder(key: jax.Array, config: EncoderConfig, inputs: int) -> Params:
    """For images of `inputs` channels; two more say where a pixel is."""
    widths, kernels = (inputs + 2, *config.channels), (5, *(3,) * (len(config.channels) - 1))
    last, *keys = jax.random.split(key, len(kernels) + 1)
    convolutions = [
        {
            "w": jax.random.normal(k, (side, side, widths[i], widths[i + 1])) * np.sqrt(2 / (side * side * widths[i])),
            "b": jnp.zeros(widths[i + 1]),
        }
        for i, (k, side) in enumerate(zip(keys, kernels, strict=True))
    ]
    side = config.size // 2 ** len(kernels)
    return {"convolutions": convolutions, "out": init_dense(last, side * side * widths[-1], config.hidden)}


def encode(params: Params, config: EncoderConfig, images: jax.Array) -> jax.Array:
    """Features [B, hidden] of images [B, H, W, C] in [-1, 1]; H and W are multiples of `config.size`."""
    x = shrink(images, config.size)
    at = jnp.linspace(-1, 1, config.size)
    where = jnp.broadcast_to(jnp.stack(jnp.meshgrid(at, at), -1), (*x.shape[:3], 2))
    x = jnp.concatenate([x, where], -1)
    for layer in params["convolutions"]:
        x = jax.lax.conv_general_dilated(x, layer["w"], (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
        x = jax.nn.relu(x + layer["b"])
    return jax.nn.relu(dense(params["out"], x.reshape(len(x), -1)))


def shrink(images: jax.Array, size: int) -> jax.Array:
    """[B, size, size, C]: means of squares of pixels. Raises ConfigError where they do not divide."""
    batch, height, width, channels = images.shape
    require(
        height % size == 0 == width % size,
        f"images of {height} x {width} pixels cannot be averaged down to {size} x {size}; choose a size that divides them",
    )
    if (height, width) == (size, size):
        return images
    return images.reshape(batch, size, height // size, size, width // size, channels).mean((2, 4))


def shrink_bytes(images: np.ndarray, size: int) -> np.ndarray:
    """`shrink` of uint8 images [..., H, W, 3] in advance, rounded: training then moves fewer bytes."""
    height, width = images.shape[-3:-1]
    require(height % size == 0 == width % size, f"images of {height} x {width} pixels cannot be averaged down to {size}")
    parts = images.reshape(*images.shape[:-3], size, height // size, size, width // size, images.shape[-1])
    return np.round(parts.mean((-4, -2), dtype=np.float32)).astype(np.uint8)


def lit(frames: jax.Array, key: jax.Array, strength: float) -> jax.Array:
    """Frames [B, n, H, W, 3] in [-1, 1] of episodes each under another light: colours scaled and moved a little."""
    shape = (len(frames), 1, 1, 1, 3)
    gain, offset = strength * jax.random.normal(key, (2, *shape))
    return frames * (1 + gain) + offset


def as_floats(images: jax.Array) -> jax.Array:
    """uint8 [..., H, W, 3] to [-1, 1]."""
    return images.astype(jnp.float32) / 127.5 - 1


def beside(frames: jax.Array) -> jax.Array:
    """[B, H, W, 3 n] of the last n frames [B, n, H, W, 3]: the newest, then how each before it differs from it."""
    newest = frames[:, -1:]
    stacked = jnp.concatenate([newest, newest - frames[:, :-1]], 1)
    return jnp.moveaxis(stacked, 1, 3).reshape(*stacked.shape[:1], *stacked.shape[2:4], -1)
