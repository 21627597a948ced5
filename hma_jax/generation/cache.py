"""Passes over a window of T positions, with a cache of its finished frames.

Spatial attention stays inside a frame and temporal attention is causal, so later frames need only the keys and values
of a finished one. `Window.start` caches a prompt, `query` predicts a masked frame, and `extend_and_query` adds a
finished frame to the cache and predicts the next one for the first time, both in one pass. `steps` combines them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.generation.decoding import Frame, blank_frame
from hma_jax.model.hma import HMA, Outputs, causal_mask
from hma_jax.model.trunk import TemporalCache


class FrameCache(NamedTuple):
    """A key-value cache of a window's finished frames."""

    layers: TemporalCache  # keys and values [N, B, capacity, P, H, I], and what cross-attention needs
    valid: jax.Array  # bool [capacity]: slots that hold a frame

    @property
    def capacity(self) -> int:
        return self.valid.shape[0]

    def write(self, layers: TemporalCache, slot: int | jax.Array) -> FrameCache:
        """The cache with the frames of `layers` written into the slots from `slot` on."""

        def put(old: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new, slot, axis=2)

        count = layers.time.keys.shape[2]
        valid = jax.lax.dynamic_update_slice_in_dim(self.valid, jnp.ones(count, bool), slot, axis=0)
        return FrameCache(jax.tree.map(put, self.layers, layers), valid)


class Window(NamedTuple):
    """What all passes over a window have in common."""

    model: HMA
    actions_BTU: jax.Array  # as `HMA.align` arranges them
    action_hidden_BT: jax.Array | None  # frames that are shown no action
    embodiment_B: jax.Array

    @classmethod
    def over(
        cls, model: HMA, chunks_BTU: jax.Array, action_hidden_BT: jax.Array | None, embodiment_B: jax.Array
    ) -> Window:
        """A window of recorded chunks. Chunks that `action_hidden_BT` marks (None: none) are not shown to the model."""
        shape = chunks_BTU.shape[:2]
        return cls(model, model.align(chunks_BTU), model.align_hidden(action_hidden_BT, shape), embodiment_B)

    def empty(self, batch: int, capacity: int) -> FrameCache:
        """A cache that holds no frames, with `capacity` slots."""
        blank = blank_frame(self.model.config, batch)

        def one_frame() -> TemporalCache | None:
            return self._pass(blank.values[:, None], blank.masked[:, None], 0, cache_frames=1).cache

        shapes = jax.eval_shape(one_frame)
        layers = jax.tree.map(lambda x: jnp.zeros((*x.shape[:2], capacity, *x.shape[3:]), x.dtype), shapes)
        return FrameCache(layers, jnp.zeros(capacity, bool))

    def start(self, frames: jax.Array, capacity: int) -> FrameCache:
        """The cache of finished frames [B, T', S (, C)] at the first positions, with `capacity` slots in all."""
        batch, count = frames.shape[:2]
        cache = self.empty(batch, capacity)
        if not count:
            return cache
        return cache.write(self._pass(frames, None, 0, cache_frames=count, predict_from=count).cache, 0)

    def query(self, cache: FrameCache, last: jax.Array, frame: Frame, at: int | jax.Array) -> jax.Array:
        """Predictions [B, S, ...] for a partly masked frame at position `at`, after frame `last` [B, S (, C)]."""
        visible = jnp.append(cache.valid, True)[None]
        values, masked = frame.values[:, None], frame.masked[:, None]
        return self._pass(values, masked, at, cache.layers, visible, before=last[:, None]).token_outputs[:, 0]

    def extend_and_query(
        self,
        cache: FrameCache | None,
        finished: jax.Array,
        at: int | jax.Array,
        slot: int | jax.Array,
        positions: jax.Array | None = None,
    ) -> tuple[FrameCache, jax.Array]:
        """Returns (the cache with the frames `finished` [B, n, S (, C)] from `slot` on, predictions for the wholly
        masked frame after them), computed in one pass.

        The frames, the masked one included, take the actions of the positions from `at` on; they also stand at these
        positions, unless `positions` [n + 1] are given. Without a cache they are the first frames of the window.
        """
        count = finished.shape[1]
        blank = blank_frame(self.model.config, len(finished))
        values = jnp.concatenate([finished, blank.values[:, None].astype(finished.dtype)], axis=1)
        masked = jnp.broadcast_to((jnp.arange(count + 1) == count)[None, :, None], values.shape[:3])
        if cache is None:
            out = self._pass(values, masked, at, cache_frames=count, predict_from=count)
            return FrameCache(out.cache, jnp.ones(count, bool)), out.token_outputs[:, 0]
        # The frames that `finished` overwrites are in its own past, but outside the window of the masked frame.
        slots = jnp.arange(cache.capacity)
        remaining = cache.valid & ~((slots >= slot) & (slots < slot + count))
        earlier = jnp.stack([cache.valid] * count + [remaining])
        visible = jnp.concatenate([earlier, causal_mask(count + 1)], axis=1)
        out = self._pass(values, masked, at, cache.layers, visible, positions, cache_frames=count, predict_from=count)
        return cache.write(out.cache, slot), out.token_outputs[:, 0]

    def _pass(
        self,
        values: jax.Array,
        masked: jax.Array | None,
        at: int | jax.Array,
        past: TemporalCache | None = None,
        visible: jax.Array | None = None,
        positions: jax.Array | None = None,
        **options: Any,
    ) -> Outputs:
        """One pass over frames that take the actions of the positions from `at` on; they also stand at these positions,
        unless `positions` are given. `options` are passed to the model."""
        count = values.shape[1]
        hidden = None if self.action_hidden_BT is None else cut(self.action_hidden_BT, at, count)
        return self.model(
            values,
            masked,
            cut(self.actions_BTU, at, count),
            self.embodiment_B,
            action_hidden_BT=hidden,
            visible=visible,
            positions=at + jnp.arange(count) if positions is None else positions,
            past=past,
            **options,
        )


def cut(x: jax.Array, first: int | jax.Array, count: int) -> jax.Array:
    """`count` frames of [B, T, ...] from `first` on."""
    return jax.lax.dynamic_slice_in_dim(x, first, count, axis=1)
