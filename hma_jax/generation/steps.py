"""The three ways to make the next frame.

`fill` is used while the window fills: one pass over two frames (the newest finished frame enters the cache, the new one
is predicted for the first time) and M - 1 passes over one frame. Positions are absolute: once the window slides, every
frame in it has another position and another past. `slide` computes the window again for each new frame, which is exact.
`stream` reuses what was computed before, which is an approximation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.cache import FrameCache, Window
from hma_jax.generation.decoding import Frame, decode_frame


def fill(
    window: Window, cache: FrameCache, last: jax.Array, t: jax.Array, key_B: jax.Array, decode: DecodeConfig
) -> tuple[FrameCache, jax.Array]:
    """Frame t at position t; `last` [B, S (, C)] is frame t - 1, which enters the cache."""
    cache, token_outputs = window.extend_and_query(cache, last[:, None], t - 1, t - 1)
    return cache, _decode(window, cache, last, token_outputs, t, key_B, decode)


def slide(window: Window, past: jax.Array, key_B: jax.Array, decode: DecodeConfig) -> jax.Array:
    """The frame at the last position after `past` [B, T - 1, S (, C)]."""
    cache, token_outputs = window.extend_and_query(None, past, 0, 0)
    return _decode(window, cache, past[:, -1], token_outputs, past.shape[1], key_B, decode)


def stream(
    window: Window, cache: FrameCache, last: jax.Array, t: jax.Array, key_B: jax.Array, decode: DecodeConfig
) -> tuple[FrameCache, jax.Array]:
    """Frame t >= T at the last position. The cache is a ring of the keys and values of the T - 1 frames before it.

    Approximate: these frames were computed at other positions and had seen older frames.
    """
    end = cache.capacity
    oldest = (t - 1) % end  # the slot of frame t - T, which leaves the window
    positions = jnp.array([end, end])  # frame t - 1 was at the last position when it was made
    cache, token_outputs = window.extend_and_query(cache, last[:, None], end - 1, oldest, positions)
    return cache, _decode(window, cache, last, token_outputs, end, key_B, decode)


def _decode(
    window: Window,
    cache: FrameCache,
    last: jax.Array,
    token_outputs: jax.Array,
    at: int | jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> jax.Array:
    def predict(frame: Frame) -> jax.Array:
        return window.query(cache, last, frame, at)

    return decode_frame(window.model, token_outputs, predict, key_B, decode)
