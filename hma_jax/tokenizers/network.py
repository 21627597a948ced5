"""The convolutional encoder and decoder around the latents. NHWC, no batch statistics.

The encoder is one convolution with the stride of a token, followed by 1x1 layers, so a token depends only on its own
patch of the image. A patch in which nothing moves therefore keeps its token, whatever happens beside it, and a world
model can copy it. Only the decoder sees beyond a patch.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx

from hma_jax.config import TokenizerConfig
from hma_jax.kernels.dense import matmul_direct_grad
from hma_jax.model.params import bias, normal, ones, param


class Conv(nnx.Module):
    """A stride-1 convolution with bias, "same" padding: [B, H, W, c_in] -> [B, H, W, c_out].

    Written as one matrix product over shifted copies: XLA's gradient of a convolution is many times slower on CPUs,
    while on accelerators both become the same product.
    """

    def __init__(self, c_in: int, c_out: int, size: int = 1, gain: float = 1.0):
        std = gain / math.sqrt(size * size * c_in)
        self.kernel = param((size * size * c_in, c_out), ("C_in", "C_out"), normal(std), role="hidden")
        self.bias = bias((c_out,), ("C_out",))
        self.size = size

    def __call__(self, x: jax.Array) -> jax.Array:
        if self.size > 1:
            height, width, reach = x.shape[1], x.shape[2], self.size // 2
            padded = jnp.pad(x, ((0, 0), (reach, reach), (reach, reach), (0, 0)))
            offsets = [(i, j) for i in range(self.size) for j in range(self.size)]
            shifted = [padded[:, i : i + height, j : j + width] for i, j in offsets]
            x = jnp.concatenate(shifted, axis=-1)
        return matmul_direct_grad(x, self.kernel[...]) + self.bias[...]


class Norm(nnx.Module):
    """RMS norm over channels, separately at each position."""

    def __init__(self, channels: int):
        self.gain = param((channels,), ("C_in",), ones, role="vector", decay=False)

    def __call__(self, x: jax.Array) -> jax.Array:
        return x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-6) * self.gain[...]


class ResBlock(nnx.Module):
    """x + conv(swish(conv(norm(x)))); the last convolution starts small."""

    def __init__(self, channels: int):
        self.norm = Norm(channels)
        self.conv_in = Conv(channels, channels, gain=1.4)
        self.conv_out = Conv(channels, channels, gain=0.3)

    def __call__(self, x: jax.Array) -> jax.Array:
        return x + self.conv_out(jax.nn.silu(self.conv_in(self.norm(x))))


class Encoder(nnx.Module):
    """Images [B, H, W, 3] in -1..1 -> latents [B, S, bits] in -1..1."""

    def __init__(self, config: TokenizerConfig):
        width = config.channels
        self.patch = config.downsample
        self.stem = Conv(3 * self.patch**2, width)
        self.blocks = nnx.List([ResBlock(width) for _ in range(config.encoder_blocks)])
        self.norm = Norm(width)
        self.head = Conv(width, config.bits)

    def __call__(self, images: jax.Array) -> jax.Array:
        x = self.stem(rearrange(images, "b (h p) (w q) c -> b h w (p q c)", p=self.patch, q=self.patch))
        for block in self.blocks:
            x = block(x)
        # Bounded: an unbounded latent far from zero would hardly ever change its sign, and one that is not quantised
        # would outgrow the noise with which it is trained.
        return rearrange(jnp.tanh(self.head(self.norm(x))), "b h w c -> b (h w) c")


class Decoder(nnx.Module):
    """Latents [B, S, bits] in -1..1, or the codes -1 and +1 -> images [B, H, W, 3], about -1..1."""

    def __init__(self, config: TokenizerConfig):
        width = config.channels
        self.patch, self.grid = config.downsample, config.grid
        self.stem = Conv(config.bits, width, 3)
        self.blocks = nnx.List([ResBlock(width) for _ in range(config.decoder_blocks)])
        self.norm = Norm(width)
        self.head = Conv(width, 3 * self.patch**2, gain=0.5)

    def __call__(self, codes: jax.Array) -> jax.Array:
        x = self.stem(rearrange(codes, "b (h w) c -> b h w c", h=self.grid))
        for block in self.blocks:
            x = block(x)
        x = self.head(self.norm(x))
        return rearrange(x, "b h w (p q c) -> b (h p) (w q) c", p=self.patch, q=self.patch)


class Autoencoder(nnx.Module):
    """Encoder and decoder, declared together so that they share one parameter tree."""

    def __init__(self, config: TokenizerConfig):
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)


def from_pixels(images: jax.Array) -> jax.Array:
    """uint8 or float images in 0..255 to float32 in -1..1."""
    return images.astype(jnp.float32) / 127.5 - 1.0


def to_pixels(images: jax.Array) -> jax.Array:
    """Network output to float32 in 0..255, clipped."""
    return jnp.clip((images + 1.0) * 127.5, 0.0, 255.0)
