"""Layers of the pretrained networks, which PyTorch calls Conv2d, Conv3d, Linear and GroupNorm.

Channels come last: images [B, H, W, C], clips [B, T, H, W, C]. Everything is computed in the type of its input, except
normalisation and softmax, which are in float32. Attributes are named as in the files from which the weights come, so
that names on both sides differ by a rule (`convert.pretrained`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.model.params import bias, normal, ones, param

PRECISION = jax.lax.Precision.HIGHEST
"""Full float32 on accelerators too: their default precision would flip bits of latents near zero."""


class Conv(nnx.Module):
    """[B, H, W, c_in] -> [B, H', W', c_out]; `padding` (before, after) is that of both ((top, bottom), (left,
    right))."""

    def __init__(
        self,
        c_in: int,
        c_out: int,
        size: int = 3,
        *,
        stride: int = 1,
        padding: tuple[int, int] | None = None,
        use_bias: bool = True,
    ):
        std = 1 / math.sqrt(size * size * c_in)
        axes = (None, None, "C_in", "C_out")
        self.kernel = param((size, size, c_in, c_out), axes, normal(std), role="hidden")
        self.bias = bias((c_out,), ("C_out",)) if use_bias else None
        self.stride = stride
        self.padding = (size // 2, size // 2) if padding is None else padding

    def __call__(self, x: jax.Array) -> jax.Array:
        y = jax.lax.conv_general_dilated(
            x,
            self.kernel[...].astype(x.dtype),
            window_strides=(self.stride, self.stride),
            padding=(self.padding, self.padding),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=PRECISION,
        )
        return y if self.bias is None else y + self.bias[...].astype(x.dtype)


class TimeConv(nnx.Module):
    """A convolution over three frames: [B, T, H, W, c_in] -> [B, T, H, W, c_out], zeros beyond the clip."""

    def __init__(self, c_in: int, c_out: int):
        axes = (None, "C_in", "C_out")
        self.kernel = param((3, c_in, c_out), axes, normal(1 / math.sqrt(3 * c_in)), role="hidden")
        self.bias = bias((c_out,), ("C_out",))

    def __call__(self, x: jax.Array) -> jax.Array:
        frames, kernel = x.shape[1], self.kernel[...].astype(x.dtype)
        padded = jnp.pad(x, ((0, 0), (1, 1), (0, 0), (0, 0), (0, 0)))
        # In a clip of one frame the outer taps, two thirds of the work, see only zeros.
        taps = (0, 1, 2) if frames > 1 else (1,)
        terms = [jnp.matmul(padded[:, i : i + frames], kernel[i], precision=PRECISION) for i in taps]
        return sum(terms) + self.bias[...].astype(x.dtype)


class Dense(nnx.Module):
    """[..., c_in] -> [..., c_out] with bias."""

    def __init__(self, c_in: int, c_out: int):
        self.kernel = param((c_in, c_out), ("C_in", "C_out"), normal(1 / math.sqrt(c_in)), role="hidden")
        self.bias = bias((c_out,), ("C_out",))

    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.kernel[...].astype(x.dtype)
        return jnp.matmul(x, kernel, precision=PRECISION) + self.bias[...].astype(x.dtype)


class GroupNorm(nnx.Module):
    """Normalises [B, ..., C] over all positions and the channels of a group.

    The frames of a clip are included: they share one mean and deviation.
    """

    def __init__(self, channels: int, groups: int, eps: float = 1e-6):
        self.gain = param((channels,), ("C_in",), ones, role="vector", decay=False)
        self.bias = bias((channels,), ("C_in",))
        self.groups, self.eps = groups, eps

    def __call__(self, x: jax.Array) -> jax.Array:
        flat = x.astype(jnp.float32).reshape(x.shape[0], -1, x.shape[-1])
        # Two passes, because images of very low contrast have deviations far below their mean.
        centred = flat - self._over_groups(flat.mean(1))
        deviation = jax.lax.rsqrt(self._over_groups(jnp.square(centred).mean(1)) + self.eps)
        y = centred * (deviation * self.gain[...]) + self.bias[...]
        return y.reshape(x.shape).astype(x.dtype)

    def _over_groups(self, per_channel: jax.Array) -> jax.Array:
        """[B, C] -> [B, 1, C], each value replaced by its group's mean."""
        batch, channels = per_channel.shape
        mean = per_channel.reshape(batch, self.groups, -1).mean(-1)
        return jnp.repeat(mean, channels // self.groups, axis=-1)[:, None]


class ResBlock(nnx.Module):
    """x + conv(silu(norm(conv(silu(norm(x)))))), where x goes through a 1x1 convolution if the number
    of channels changes. `conv` and `norm` make the two of each."""

    def __init__(
        self,
        c_in: int,
        c_out: int,
        norm: Callable[[int], nnx.Module],
        conv: Callable[[int, int], nnx.Module],
        *,
        shortcut_bias: bool = True,
    ):
        self.norm1, self.conv1 = norm(c_in), conv(c_in, c_out)
        self.norm2, self.conv2 = norm(c_out), conv(c_out, c_out)
        self.shortcut = Conv(c_in, c_out, 1, use_bias=shortcut_bias) if c_in != c_out else None

    def __call__(self, x: jax.Array) -> jax.Array:
        h = self.conv1(jax.nn.silu(self.norm1(x)))
        h = self.conv2(jax.nn.silu(self.norm2(h)))
        return (x if self.shortcut is None else self.shortcut(x)) + h


class Attention(nnx.Module):
    """One head over all positions of an image, with the input added: [B, H, W, C] -> the same shape."""

    def __init__(self, channels: int, groups: int):
        self.group_norm = GroupNorm(channels, groups)
        self.to_q, self.to_k, self.to_v = (Dense(channels, channels) for _ in range(3))
        self.to_out = nnx.List([Dense(channels, channels)])

    def __call__(self, x: jax.Array) -> jax.Array:
        batch, *_, channels = x.shape
        h = self.group_norm(x).reshape(batch, -1, channels)
        q, k, v = self.to_q(h), self.to_k(h), self.to_v(h)
        scores = jnp.einsum("bqc,bkc->bqk", q, k, precision=PRECISION).astype(jnp.float32)
        weights = jax.nn.softmax(scores / math.sqrt(channels), axis=-1).astype(x.dtype)
        h = jnp.einsum("bqk,bkc->bqc", weights, v, precision=PRECISION)
        return x + self.to_out[0](h).reshape(x.shape)
