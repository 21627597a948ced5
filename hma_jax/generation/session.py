"""Rollouts one frame at a time, for callers that choose actions by looking at frames. The frames equal those of
`rollout`.

A session's arrays keep their shapes, so one compiled `advance` serves an episode of any length:

    step = jax.jit(lambda p, s, a, k: advance(declared.merge(p), s, a, k, decode), donate_argnums=1)
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, require
from hma_jax.config.base import require_shapes
from hma_jax.generation import steps
from hma_jax.generation.cache import FrameCache, Window
from hma_jax.kernels.random import fold_in_each
from hma_jax.model.given import Array, as_frames, require_finite, require_keys, require_known
from hma_jax.model.hma import HMA

Phase = Literal["filling", "sliding"]
"""Whether the next frame still fits in the window (`filling`), or the oldest frame leaves it (`sliding`)."""


class Session(NamedTuple):
    """The state of B simulated episodes of equal length."""

    cache: FrameCache  # of all finished frames except the newest; T - 1 slots
    frames: jax.Array  # the newest T - 1, oldest first: [B, T - 1, S (, C)]
    chunks_BTU: jax.Array  # raw [B, T, U], the chunk executed after each of these frames, and a spare one
    action_hidden_BT: jax.Array  # chunks the model is not shown
    embodiment_B: jax.Array
    count: jax.Array  # int32: frames so far


def start(
    model: HMA,
    prompt: Array,
    chunks_BTU: Array,
    embodiment_B: Array,
    *,
    action_hidden_BT: Array | None = None,
) -> Session:
    """A session that has seen `prompt` [B, T', S (, C)]; only the last T - 1 frames are used.

    `chunks_BTU` [B, T' - 1, U] are those executed between its frames. Raises ConfigError for shapes that do not fit the
    model or each other, and for unknown ids and robots as `rollout`.
    """
    capacity, count = model.config.frames - 1, prompt.shape[1]
    require(capacity >= 1, "a model with model.frames 1 cannot generate frames: it needs at least 2")
    require(count >= 1, "a session needs at least 1 prompt frame, got 0")
    between = (len(prompt), count - 1)
    hidden = jnp.zeros(between, bool) if action_hidden_BT is None else action_hidden_BT
    require_shapes(
        f"a session of {count} prompt frames starts with",
        {"frames": prompt, "chunks between them": chunks_BTU, "hidden": hidden, "robots": embodiment_B},
        {
            "frames": (len(prompt), count, *model.config.frame_shape),
            "chunks between them": (*between, model.table.action_width),
            "hidden": between,
            "robots": between[:1],
        },
    )
    require_known(model.config, model.table, prompt, chunks_BTU, embodiment_B)
    prompt = as_frames(model.config, prompt)
    old = max(count - capacity, 0)
    chunks, hidden = (_padded(x[:, old:], capacity + 1) for x in (chunks_BTU, hidden))
    past = Window.over(model, chunks, hidden, embodiment_B).start(prompt[:, old:-1], capacity)
    return Session(past, _padded(prompt[:, old:], capacity), chunks, hidden, embodiment_B, jnp.int32(count - old))


def advance(
    model: HMA,
    session: Session,
    chunk_BU: Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    next_chunk_BU: Array | None = None,
    action_hidden_B: Array | None = None,
    phase: Phase | None = None,
) -> tuple[Session, jax.Array]:
    """(session, frame [B, S (, C)]) after the raw chunk `chunk_BU` was executed.

    Frame t is drawn from fold_in(key, t), as in `rollout`. With released alignment a frame is also shown the chunk that
    comes after it: `next_chunk_BU`, or, if that is None, `chunk_BU` again (as in the release's simulator).
    `action_hidden_B` marks chunks that the model is not shown. If the caller gives the `phase` that the session is in,
    the program of the other phase is not compiled. Raises ConfigError as `start`; inside `jax.jit`, where values are
    not known, only for shapes.
    """
    capacity, t = model.config.frames - 1, session.count
    batch, _, width = session.chunks_BTU.shape
    action_hidden_B = jnp.zeros(batch, bool) if action_hidden_B is None else action_hidden_B
    next_chunk_BU = chunk_BU if next_chunk_BU is None else next_chunk_BU
    require_shapes(
        "a session goes on by",
        {"chunk": chunk_BU, "next chunk": next_chunk_BU, "hidden": action_hidden_B},
        {"chunk": (batch, width), "next chunk": (batch, width), "hidden": (batch,)},
    )
    require_finite(chunk_BU)
    require_finite(next_chunk_BU)
    require_keys(key_B, batch)
    last = jnp.minimum(t, capacity) - 1
    both = jnp.stack([chunk_BU, next_chunk_BU], axis=1)
    chunks = _written(session.chunks_BTU, both, last)
    hidden = _written(session.action_hidden_BT, jnp.stack([action_hidden_B, action_hidden_B], axis=1), last)
    window = Window.over(model, chunks, hidden, session.embodiment_B)
    newest = jax.lax.dynamic_index_in_dim(session.frames, last, axis=1, keepdims=False)
    keys = fold_in_each(key_B, t)

    def within_the_window() -> tuple[FrameCache, jax.Array]:
        return steps.fill(window, session.cache, newest, t, keys, decode)

    def past_the_window() -> tuple[FrameCache, jax.Array]:
        if decode.slide == "streaming":
            return steps.stream(window, session.cache, newest, t, keys, decode)
        return session.cache, steps.slide(window, session.frames, keys, decode)

    if phase is None:
        cache, frame = jax.lax.cond(t <= capacity, within_the_window, past_the_window)
    else:
        cache, frame = within_the_window() if phase == "filling" else past_the_window()
    full = t >= capacity  # then the oldest frame is dropped
    frames, chunks, hidden = (jnp.where(full, jnp.roll(x, -1, axis=1), x) for x in (session.frames, chunks, hidden))
    frames = _written(frames, frame[:, None], jnp.minimum(t, capacity - 1))
    return Session(cache, frames, chunks, hidden, session.embodiment_B, t + 1), frame


def _padded(x: jax.Array, size: int) -> jax.Array:
    """[B, T', ...] -> [B, size, ...], zeros at the end."""
    return jnp.pad(x, [(0, 0), (0, size - x.shape[1])] + [(0, 0)] * (x.ndim - 2))


def _written(x: jax.Array, new: jax.Array, at: jax.Array) -> jax.Array:
    """x [B, T, ...] with `new` [B, n, ...] from frame `at` on."""
    return jax.lax.dynamic_update_slice_in_dim(x, new.astype(x.dtype), at, axis=1)
