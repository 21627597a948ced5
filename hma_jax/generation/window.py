"""Cached passes over the window of T positions that a model was trained on.

Spatial attention stays inside a frame and temporal attention is causal, so all that later
frames need of a finished frame is in its cache. While the window fills, a new frame costs one
pass over two frames (the newest finished one enters the cache, the new one is first looked at)
and M - 1 passes over one. Positions are absolute: once the window slides, every frame in it
has another position and another past. `slide` computes the window again, once per new frame,
which is exact. `stream` keeps what was computed, which is an approximation.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.decoding import Frame, blank_frame, decode_frame
from hma_jax.model.hma import HMA, Outputs, causal
from hma_jax.model.trunk import TemporalCache


class Window(NamedTuple):
    """What all passes over the positions of a window share."""

    model: HMA
    actions_BTU: jax.Array  # as `HMA.align` arranges them
    hidden_BT: jax.Array | None  # frames that are shown no action
    embodiment_B: jax.Array

    @classmethod
    def over(
        cls, model: HMA, chunks_BTU: jax.Array, hidden_BT: jax.Array | None, embodiment_B: jax.Array
    ) -> Window:
        """From recorded chunks and which of them the model is not shown (None: it sees all)."""
        shape = chunks_BTU.shape[:2]
        return cls(model, model.align(chunks_BTU), model.align_hidden(hidden_BT, shape), embodiment_B)

    def prefill(self, frames: jax.Array, room: int) -> TemporalCache:
        """The cache of finished frames [B, T', S (, C)] at the first positions, with `room` in all."""
        count = frames.shape[1]
        if not count:
            return empty_cache(self.model, len(frames), room)
        new = self.pass_over(frames, None, 0, keep=count).cache
        missing = room - count
        return jax.tree.map(lambda x: jnp.pad(x, [(0, 0)] * 2 + [(0, missing)] + [(0, 0)] * (x.ndim - 3)), new)

    def fill(
        self, cache: TemporalCache, last: jax.Array, t: jax.Array, key_B: jax.Array, decode: DecodeConfig
    ) -> tuple[TemporalCache, jax.Array]:
        """Frame t at position t; `last` is frame t - 1, which enters the cache."""
        earlier = jnp.arange(room_of(cache)) < t - 1
        out = self.commit_and_look(cache, last, t - 1, earlier, earlier, t + jnp.array([-1, 0]))
        cache = write_cache(cache, out.cache, t - 1)
        look = lambda f: self.look(cache, f, t, jnp.arange(room_of(cache)) < t)  # noqa: E731
        return cache, decode_frame(self.model, out.frames[:, 1], look, key_B, decode)

    def slide(self, past: jax.Array, key_B: jax.Array, decode: DecodeConfig) -> jax.Array:
        """The frame at the last position after `past` [B, T - 1, S (, C)]: one pass over the whole
        window, M - 1 over one frame."""
        count = past.shape[1]
        blank = blank_frame(self.model.config, len(past))
        values = jnp.concatenate([past, blank.values[:, None].astype(past.dtype)], axis=1)
        masked = jnp.broadcast_to((jnp.arange(count + 1) == count)[None, :, None], values.shape[:3])
        out = self.pass_over(values, masked, 0, keep=count)
        look = lambda f: self.look(out.cache, f, count, jnp.ones(count, bool))  # noqa: E731
        return decode_frame(self.model, out.frames[:, -1], look, key_B, decode)

    def stream(
        self, cache: TemporalCache, last: jax.Array, t: jax.Array, key_B: jax.Array, decode: DecodeConfig
    ) -> tuple[TemporalCache, jax.Array]:
        """Frame t >= T at the last position, over a ring of what the T - 1 frames before it left.

        Approximate: those frames were computed at other positions and had seen older ones.
        """
        room = room_of(cache)
        slot = (t - 1) % room  # where frame t - T lies, which leaves the window
        everything, but_oldest = jnp.ones(room, bool), jnp.arange(room) != slot
        at = jnp.array([room, room])  # frame t - 1 stood at the last position when it was made
        out = self.commit_and_look(cache, last, room - 1, everything, but_oldest, at)
        cache = write_cache(cache, out.cache, slot)
        look = lambda f: self.look(cache, f, room, everything)  # noqa: E731
        return cache, decode_frame(self.model, out.frames[:, 1], look, key_B, decode)

    def commit_and_look(
        self,
        cache: TemporalCache,
        last: jax.Array,
        first: int | jax.Array,
        seen_by_last: jax.Array,
        seen_by_next: jax.Array,
        positions: jax.Array,
    ) -> Outputs:
        """One pass over the finished frame `last` and the masked one after it, which take the
        actions of slots `first` and `first` + 1."""
        blank = blank_frame(self.model.config, len(last))
        values = jnp.stack([last, blank.values.astype(last.dtype)], axis=1)
        masked = jnp.stack([jnp.zeros_like(blank.masked), blank.masked], axis=1)
        visible = jnp.concatenate([jnp.stack([seen_by_last, seen_by_next]), causal(2)], axis=1)
        return self.pass_over(values, masked, first, cache, visible, positions, keep=1)

    def look(self, cache: TemporalCache, frame: Frame, t: int | jax.Array, seen: jax.Array) -> jax.Array:
        """What the model says of the frame at position t, given those that are `seen` in the cache."""
        visible = jnp.append(seen, True)[None]
        return self.pass_over(frame.values[:, None], frame.masked[:, None], t, cache, visible).frames[:, 0]

    def pass_over(
        self,
        values: jax.Array,
        masked: jax.Array | None,
        first: int | jax.Array,
        past: TemporalCache | None = None,
        visible: jax.Array | None = None,
        positions: jax.Array | None = None,
        keep: int = 0,
    ) -> Outputs:
        """One pass over frames that take the actions of slots `first` onwards; the first `keep` are cached."""
        part = lambda x: (  # noqa: E731
            None if x is None else jax.lax.dynamic_slice_in_dim(x, first, values.shape[1], axis=1)
        )
        return self.model(
            values,
            masked,
            part(self.actions_BTU),
            self.embodiment_B,
            hidden_BT=part(self.hidden_BT),
            visible=visible,
            first=first,
            positions=positions,
            past=past,
            keep=keep,
        )


def room_of(cache: TemporalCache) -> int:
    """T_past: how many frames a cache has room for."""
    return cache.time[0].shape[2]


def write_cache(cache: TemporalCache, new: TemporalCache, slot: jax.Array) -> TemporalCache:
    """`cache` with the one frame of `new` in `slot`."""
    put = lambda c, n: jax.lax.dynamic_update_slice_in_dim(c, n, slot, axis=2)  # noqa: E731
    return jax.tree.map(put, cache, new)


def empty_cache(model: HMA, batch: int, room: int) -> TemporalCache:
    """A cache of nothing."""

    def one_frame() -> TemporalCache:
        blank = blank_frame(model.config, batch)
        chunks, robots = jnp.zeros((batch, 1, model.table.action_width)), jnp.zeros(batch, jnp.int32)
        window = Window.over(model, chunks, None, robots)
        return window.pass_over(blank.values[:, None], blank.masked[:, None], 0, keep=1).cache

    shapes = jax.eval_shape(one_frame)
    return jax.tree.map(lambda x: jnp.zeros((*x.shape[:2], room, *x.shape[3:]), x.dtype), shapes)
