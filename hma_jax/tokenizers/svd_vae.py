"""The networks of Stable Video Diffusion's VAE: images to a Gaussian over latents, latents to clips.

The encoder sees single images. The decoder mixes the frames of a clip: every residual block over space is followed by
one over time, and a learned number weighs the two. Tokens of HMA models, including released ones, are decoded as clips
of one frame; longer clips are used to check that the network equals the original. Source: the diffusers library's
AutoencoderKLTemporalDecoder.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import SvdVaeConfig
from hma_jax.model.params import param, zeros
from hma_jax.tokenizers.layers import Attention, Conv, GroupNorm, ResBlock, TimeConv

TIME_EPS = 1e-5
"""Epsilon of the normalisations over a clip; all others have 1e-6."""


def _block(config: SvdVaeConfig, c_in: int, c_out: int) -> ResBlock:
    return ResBlock(c_in, c_out, partial(GroupNorm, groups=config.groups), Conv)


# --- Encoder ---------------------------------------------------------------------------------


class Downsample(nnx.Module):
    """Halves the size; pads only below and on the right."""

    def __init__(self, channels: int):
        self.conv = Conv(channels, channels, stride=2, padding=(0, 1))

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.conv(x)


class DownBlock(nnx.Module):
    def __init__(self, config: SvdVaeConfig, c_in: int, c_out: int, last: bool):
        inputs = [c_in] + [c_out] * (config.layers - 1)
        self.resnets = nnx.List([_block(config, c, c_out) for c in inputs])
        self.downsamplers = nnx.List([] if last else [Downsample(c_out)])

    def __call__(self, x: jax.Array) -> jax.Array:
        for module in (*self.resnets, *self.downsamplers):
            x = module(x)
        return x


class MidBlock(nnx.Module):
    def __init__(self, config: SvdVaeConfig, channels: int):
        self.resnets = nnx.List([_block(config, channels, channels) for _ in range(2)])
        self.attentions = nnx.List([Attention(channels, config.groups)])

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.resnets[1](self.attentions[0](self.resnets[0](x)))


class Encoder(nnx.Module):
    """Images [B, H, W, 3] in -1..1 -> [B, H / f, W / f, 2 x latent channels]."""

    def __init__(self, config: SvdVaeConfig):
        widths = config.channels
        inputs = [widths[0], *widths[:-1]]
        self.conv_in = Conv(3, widths[0])
        self.down_blocks = nnx.List(
            [
                DownBlock(config, c_in, c_out, last=i == len(widths) - 1)
                for i, (c_in, c_out) in enumerate(zip(inputs, widths, strict=True))
            ]
        )
        self.mid_block = MidBlock(config, widths[-1])
        self.conv_norm_out = GroupNorm(widths[-1], config.groups)
        self.conv_out = Conv(widths[-1], 2 * config.latent_channels)

    def __call__(self, x: jax.Array) -> jax.Array:
        x = self.conv_in(x)
        for block in self.down_blocks:
            x = block(x)
        return self.conv_out(jax.nn.silu(self.conv_norm_out(self.mid_block(x))))


# --- Decoder ---------------------------------------------------------------------------------


class TimeMixer(nnx.Module):
    """A weighted sum of spatial and temporal features: sigmoid(mix_factor) is the share of time."""

    def __init__(self):
        self.mix_factor = param((1,), (None,), zeros, role="vector", decay=False)

    def __call__(self, space: jax.Array, time: jax.Array) -> jax.Array:
        share = jax.nn.sigmoid(self.mix_factor[...]).astype(space.dtype)
        return (1 - share) * space + share * time


class SpaceTimeBlock(nnx.Module):
    """[B, T, H, W, c_in] -> [B, T, H, W, c_out]."""

    def __init__(self, config: SvdVaeConfig, c_in: int, c_out: int):
        over_clips = partial(GroupNorm, groups=config.groups, eps=TIME_EPS)
        self.spatial_res_block = _block(config, c_in, c_out)
        self.temporal_res_block = ResBlock(c_out, c_out, over_clips, TimeConv)
        self.time_mixer = TimeMixer()

    def __call__(self, x: jax.Array) -> jax.Array:
        space = _by_frame(self.spatial_res_block, x)
        return self.time_mixer(space, self.temporal_res_block(space))


class TimeMidBlock(nnx.Module):
    """As released: attention comes once, after the first block, and blocks beyond the second are never used (the
    published decoder has two)."""

    def __init__(self, config: SvdVaeConfig, channels: int):
        self.resnets = nnx.List([SpaceTimeBlock(config, channels, channels) for _ in range(config.layers)])
        self.attentions = nnx.List([Attention(channels, config.groups)])

    def __call__(self, x: jax.Array) -> jax.Array:
        x = self.resnets[0](x)
        if len(self.resnets) > 1:
            x = self.resnets[1](_by_frame(self.attentions[0], x))
        return x


class Upsample(nnx.Module):
    """Twice the size, every pixel repeated, then a convolution."""

    def __init__(self, channels: int):
        self.conv = Conv(channels, channels)

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.conv(jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2))


class UpBlock(nnx.Module):
    def __init__(self, config: SvdVaeConfig, c_in: int, c_out: int, last: bool):
        inputs = [c_in] + [c_out] * config.layers
        self.resnets = nnx.List([SpaceTimeBlock(config, c, c_out) for c in inputs])
        self.upsamplers = nnx.List([] if last else [Upsample(c_out)])

    def __call__(self, x: jax.Array) -> jax.Array:
        for block in self.resnets:
            x = block(x)
        for upsample in self.upsamplers:
            x = _by_frame(upsample, x)
        return x


class Decoder(nnx.Module):
    """Latents of clips [B, T, h, w, c] -> images [B, T, f h, f w, 3], about -1..1."""

    def __init__(self, config: SvdVaeConfig):
        widths = config.channels[::-1]
        inputs = [widths[0], *widths[:-1]]
        self.conv_in = Conv(config.latent_channels, widths[0])
        self.mid_block = TimeMidBlock(config, widths[0])
        self.up_blocks = nnx.List(
            [
                UpBlock(config, c_in, c_out, last=i == len(widths) - 1)
                for i, (c_in, c_out) in enumerate(zip(inputs, widths, strict=True))
            ]
        )
        self.conv_norm_out = GroupNorm(widths[-1], config.groups)
        self.conv_out = Conv(widths[-1], 3)
        self.time_conv_out = TimeConv(3, 3)

    def __call__(self, x: jax.Array) -> jax.Array:
        x = self.mid_block(_by_frame(self.conv_in, x))
        for block in self.up_blocks:
            x = block(x)
        x = _by_frame(lambda y: self.conv_out(jax.nn.silu(self.conv_norm_out(y))), x)
        return self.time_conv_out(x)


def _by_frame(function: Callable[[jax.Array], jax.Array], clips: jax.Array) -> jax.Array:
    """Applies `function`, which takes images, to each frame of clips [B, T, ...] separately."""
    out = function(clips.reshape(-1, *clips.shape[2:]))
    return out.reshape(*clips.shape[:2], *out.shape[1:])


# --- Both ------------------------------------------------------------------------------------


class VideoDecoder(nnx.Module):
    """The decoder; it has a parameter tree of its own where there is no encoder."""

    def __init__(self, config: SvdVaeConfig):
        self.decoder = Decoder(config)
        self.dtype = config.compute_dtype

    def decode(self, latents: jax.Array, frames: int = 1) -> jax.Array:
        """Unscaled latents [B, h, w, c] -> float32 [B, f h, f w, 3], about -1..1.

        Each group of `frames` consecutive entries of the batch is a clip.
        """
        clips = latents.astype(self.dtype).reshape(-1, frames, *latents.shape[1:])
        images = self.decoder(clips).astype(jnp.float32)
        return images.reshape(latents.shape[0], *images.shape[2:])


class SvdVae(VideoDecoder):
    """Encoder and decoder in one parameter tree."""

    def __init__(self, config: SvdVaeConfig):
        super().__init__(config)
        self.encoder = Encoder(config)
        self.quant_conv = Conv(2 * config.latent_channels, 2 * config.latent_channels, 1)

    def moments(self, images: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Images [B, H, W, 3] in -1..1 -> the posterior's mean and log variance, float32 [B, h, w, c]."""
        out = self.quant_conv(self.encoder(images.astype(self.dtype))).astype(jnp.float32)
        mean, log_variance = jnp.split(out, 2, axis=-1)
        return mean, jnp.clip(log_variance, -30.0, 20.0)
