"""The networks of the MAGVIT2 tokenizer: images to latents whose signs are the bits, and back.

The networks are those of 1X, and of Open-MAGVIT2 before its decoder had adaptive normalisation. Reference appendix A.
NHWC throughout.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx

from hma_jax.config import Magvit2Config
from hma_jax.tokenizers.layers import Conv, GroupNorm, ResBlock


def _block(config: Magvit2Config, c_in: int, c_out: int) -> ResBlock:
    norm = partial(GroupNorm, groups=config.groups)
    return ResBlock(c_in, c_out, norm, partial(Conv, use_bias=False), shortcut_bias=False)


def _blocks(config: Magvit2Config, c_in: int, c_out: int) -> nnx.List:
    inputs = [c_in] + [c_out] * (config.res_blocks - 1)
    return nnx.List([_block(config, c, c_out) for c in inputs])


class Down(nnx.Module):
    """One level of the encoder."""

    def __init__(self, config: Magvit2Config, c_in: int, c_out: int, last: bool):
        self.block = _blocks(config, c_in, c_out)
        self.downsample = None if last else Conv(c_out, c_out, stride=2)

    def __call__(self, x: jax.Array) -> jax.Array:
        for block in self.block:
            x = block(x)
        return x if self.downsample is None else self.downsample(x)


class Upsample(nnx.Module):
    """[B, H, W, C] -> [B, 2H, 2W, C]: a convolution makes four times the channels, ordered by position first, then by
    channel."""

    def __init__(self, channels: int):
        self.conv1 = Conv(channels, 4 * channels)

    def __call__(self, x: jax.Array) -> jax.Array:
        return rearrange(self.conv1(x), "b h w (i j c) -> b (h i) (w j) c", i=2, j=2)


class Up(nnx.Module):
    """One level of the decoder."""

    def __init__(self, config: Magvit2Config, c_in: int, c_out: int, last: bool):
        self.block = _blocks(config, c_in, c_out)
        self.upsample = None if last else Upsample(c_out)

    def __call__(self, x: jax.Array) -> jax.Array:
        for block in self.block:
            x = block(x)
        return x if self.upsample is None else self.upsample(x)


class Encoder(nnx.Module):
    """Images [B, H, W, 3] in -1..1 -> latents, float32 [B, H / f, W / f, bits]."""

    def __init__(self, config: Magvit2Config):
        widths = [config.channels * m for m in config.multipliers]
        inputs = [config.channels, *widths[:-1]]
        self.dtype = config.compute_dtype
        self.conv_in = Conv(3, config.channels, use_bias=False)
        self.down = nnx.List(
            [
                Down(config, c_in, c_out, last=i == len(widths) - 1)
                for i, (c_in, c_out) in enumerate(zip(inputs, widths, strict=True))
            ]
        )
        self.mid_block = _blocks(config, widths[-1], widths[-1])
        self.norm_out = GroupNorm(widths[-1], config.groups)
        self.conv_out = Conv(widths[-1], config.bits, 1)

    def __call__(self, images: jax.Array) -> jax.Array:
        x = self.conv_in(images.astype(self.dtype))
        for module in (*self.down, *self.mid_block):
            x = module(x)
        return self.conv_out(jax.nn.silu(self.norm_out(x))).astype(jnp.float32)


class Decoder(nnx.Module):
    """Codes -1 and +1 [B, h, w, bits] -> images, float32 [B, f h, f w, 3], about -1..1."""

    def __init__(self, config: Magvit2Config):
        widths = [config.channels * m for m in config.multipliers]
        inputs = [*widths[1:], widths[-1]]
        self.dtype = config.compute_dtype
        self.conv_in = Conv(config.bits, widths[-1])
        self.mid_block = _blocks(config, widths[-1], widths[-1])
        # As in the encoder, levels are counted from the image inwards; they are applied in reverse order.
        self.up = nnx.List(
            [Up(config, c_in, c_out, last=i == 0) for i, (c_in, c_out) in enumerate(zip(inputs, widths, strict=True))]
        )
        self.norm_out = GroupNorm(widths[0], config.groups)
        self.conv_out = Conv(widths[0], 3)

    def __call__(self, codes: jax.Array) -> jax.Array:
        x = self.conv_in(codes.astype(self.dtype))
        for module in (*self.mid_block, *reversed(self.up)):
            x = module(x)
        return self.conv_out(jax.nn.silu(self.norm_out(x))).astype(jnp.float32)


class Magvit2(nnx.Module):
    """Encoder and decoder in one parameter tree."""

    def __init__(self, config: Magvit2Config):
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)
