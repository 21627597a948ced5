"""Augments the past in training with displaced rectangles, so that a model learns to restore what a rollout lost.

In a rollout, an object that was once drawn as background is missing from the past of all later frames. Recorded pasts
never lack an object, so a model does not learn to bring one back. Here a rectangle of the past shows, for some
consecutive frames, the content of another place in the same frame: background in place of an object, or an object where
there is none. The true frames that follow are still the targets.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

PATCHES = 3
"""Rectangles per example."""

LARGEST = 0.5
"""Greatest side of a rectangle, as a share of the frame's."""


def displace_patches(past: jax.Array, share: float, key_B: jax.Array) -> jax.Array:
    """`past`, the tokens [B, T - 1, S] or [B, T - 1, S, C] of square frames, with rectangles displaced: each of the
    `PATCHES` rectangles of an example with probability `share`. The sides, place and frames of a rectangle are uniform,
    and so is the distance to the place that its tokens are taken from, which wraps around the frame's edges."""
    frames, tokens = past.shape[1:3]
    side = math.isqrt(tokens)
    y_S, x_S = jnp.divmod(jnp.arange(tokens), side)

    def sources(key: jax.Array) -> jax.Array:
        """int [T - 1, S]: the place that each token is taken from."""
        # Each [r, 1], for r rectangles: beside it stand frames T, or places S.
        chosen, first, last, high, wide, top, left, down, right = jax.random.uniform(key, (9, PATCHES, 1), jnp.float32)
        begin = jnp.floor(first * frames)
        end = begin + 1 + jnp.floor(last * (frames - begin))
        frame_T = jnp.arange(frames).astype(begin.dtype)
        within_rT = (chosen < share) & (frame_T >= begin) & (frame_T < end)
        within_rS = _within(y_S, side, high, top) & _within(x_S, side, wide, left)
        y_rS = (y_S + jnp.floor(down * side).astype(int)) % side
        x_rS = (x_S + jnp.floor(right * side).astype(int)) % side
        within_rTS = within_rT[:, :, None] & within_rS[:, None]
        own = jnp.broadcast_to(jnp.arange(tokens), (frames, tokens))
        # Where rectangles overlap, the first one is seen.
        return jnp.select(list(within_rTS), list(jnp.expand_dims(y_rS * side + x_rS, 1)), own)

    source_BTS = jax.vmap(sources)(key_B)
    return jnp.take_along_axis(past, source_BTS.reshape(*source_BTS.shape, *(1,) * (past.ndim - 3)), axis=2)


def _within(place_S: jax.Array, side: int, u_length: jax.Array, u_start: jax.Array) -> jax.Array:
    """bool [..., S]: inside a stretch of up to `LARGEST` of the side, wherever it fits."""
    length = 1 + jnp.floor(u_length * int(LARGEST * side))
    start = jnp.floor(u_start * (side - length + 1))
    place_S = place_S.astype(start.dtype)
    return (place_S >= start) & (place_S < start + length)
