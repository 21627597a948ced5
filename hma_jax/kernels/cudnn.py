"""Attention on NVIDIA GPUs by cuDNN's fused kernel, which never writes the weights to memory.

The kernel takes 16-bit numbers and heads whose width is a multiple of 8 and at most 128; everything else is left to
`plain`. So is attention over time, whose sequences of a dozen frames are too short for the kernel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.kernels import plain


def suits(qkv: jax.Array) -> bool:
    """Whether the kernel takes these queries, keys and values."""
    return qkv.dtype in (jnp.bfloat16, jnp.float16) and qkv.shape[-1] % 8 == 0 and qkv.shape[-1] <= 128


def within(qkv: jax.Array, scale: float) -> jax.Array:
    """As `plain.within`."""
    if not suits(qkv):
        return plain.within(qkv, scale)
    q, k, v = (x.reshape(-1, *x.shape[2:]) for x in plain.split(qkv))
    y = jax.nn.dot_product_attention(q, k, v, scale=scale, implementation="cudnn")
    return y.reshape(*qkv.shape[:3], *qkv.shape[4:])
