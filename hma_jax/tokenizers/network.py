"""The convolutional encoder and decoder around the quantiser. NHWC, no batch statistics.

An image is cut into patches (space to depth), so the first convolution already works at one
position per patch: the network spends its time where channels are wide, and matrix products
are efficient on CPUs and accelerators alike. Then residual blocks, halving the resolution
until one position is one token; the decoder mirrors it.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx

from hma_jax.config import TokenizerConfig
from hma_jax.params import bias, normal, ones, param


class Conv(nnx.Module):
    """A stride-1 convolution with bias, "same" padding: [B, H, W, c_in] -> [B, H, W, c_out]."""

    def __init__(self, c_in: int, c_out: int, size: int, gain: float = 1.0):
        std = gain / math.sqrt(size * size * c_in)
        self.kernel = param(
            (size, size, c_in, c_out), (None, None, "C_in", "C_out"), normal(std), role="hidden"
        )
        self.bias = bias((c_out,), ("C_out",))

    def __call__(self, x: jax.Array) -> jax.Array:
        y = jax.lax.conv_general_dilated(
            x, self.kernel[...], (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return y + self.bias[...]


class Norm(nnx.Module):
    """RMS norm over channels, each position by itself."""

    def __init__(self, channels: int):
        self.gain = param((channels,), ("C_in",), ones, role="vector", decay=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        return x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-6) * self.gain[...]


class ResBlock(nnx.Module):
    """x + conv(swish(conv(swish(norm(x))))); the last convolution starts small."""

    def __init__(self, channels: int):
        self.norm = Norm(channels)
        self.conv_in = Conv(channels, channels, 3, gain=1.4)
        self.conv_out = Conv(channels, channels, 3, gain=0.3)

    def __call__(self, x: jax.Array) -> jax.Array:
        return x + self.conv_out(jax.nn.silu(self.conv_in(jax.nn.silu(self.norm(x)))))


class Encoder(nnx.Module):
    """Images [B, H, W, 3] in -1..1 -> latents [B, S, bits]."""

    def __init__(self, config: TokenizerConfig):
        widths = _widths(config)
        self.patch = config.patch
        self.stem = Conv(3 * config.patch**2, widths[0], 3)
        self.levels = nnx.List(
            [nnx.List([ResBlock(w) for _ in range(config.res_blocks)]) for w in widths]
        )
        self.down = nnx.List([Conv(4 * a, b, 1) for a, b in zip(widths, widths[1:])])
        self.norm = Norm(widths[-1])
        self.head = Conv(widths[-1], config.bits, 1)

    def __call__(self, images: jax.Array) -> jax.Array:
        x = self.stem(_space_to_depth(images, self.patch))
        for i, blocks in enumerate(self.levels):
            if i > 0:
                x = self.down[i - 1](_space_to_depth(x, 2))
            for block in blocks:
                x = block(x)
        return rearrange(self.head(self.norm(x)), "b h w c -> b (h w) c")


class Decoder(nnx.Module):
    """Codes [B, S, bits] in {-1, +1} -> images [B, H, W, 3], about -1..1."""

    def __init__(self, config: TokenizerConfig):
        widths = _widths(config)[::-1]
        self.patch, self.grid = config.patch, config.grid
        self.stem = Conv(config.bits, widths[0], 3)
        self.levels = nnx.List(
            [nnx.List([ResBlock(w) for _ in range(config.res_blocks)]) for w in widths]
        )
        self.up = nnx.List([Conv(a, 4 * b, 1) for a, b in zip(widths, widths[1:])])
        self.norm = Norm(widths[-1])
        self.head = Conv(widths[-1], 3 * config.patch**2, 3, gain=0.5)

    def __call__(self, codes: jax.Array) -> jax.Array:
        x = self.stem(rearrange(codes, "b (h w) c -> b h w c", h=self.grid))
        for i, blocks in enumerate(self.levels):
            if i > 0:
                x = _depth_to_space(self.up[i - 1](x), 2)
            for block in blocks:
                x = block(x)
        return _depth_to_space(self.head(self.norm(x)), self.patch)


class Autoencoder(nnx.Module):
    """Encoder and decoder, declared together so that they share one parameter tree."""

    def __init__(self, config: TokenizerConfig):
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)


def normalise(images: jax.Array) -> jax.Array:
    """uint8 or float images in 0..255 to float32 in -1..1."""
    return images.astype(jnp.float32) / 127.5 - 1.0


def to_pixels(images: jax.Array) -> jax.Array:
    """Network output to float32 in 0..255, clipped."""
    return jnp.clip((images + 1.0) * 127.5, 0.0, 255.0)


def _widths(config: TokenizerConfig) -> list[int]:
    """Channels at each resolution, from one position per patch to one per token."""
    levels = (config.downsample // config.patch).bit_length()
    return [min(config.channels * 2**i, config.max_channels) for i in range(levels)]


def _space_to_depth(x: jax.Array, size: int) -> jax.Array:
    return rearrange(x, "b (h p) (w q) c -> b h w (p q c)", p=size, q=size)


def _depth_to_space(x: jax.Array, size: int) -> jax.Array:
    return rearrange(x, "b h w (p q c) -> b (h p) (w q) c", p=size, q=size)
