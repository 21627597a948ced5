"""Whole rollouts in one compiled call, and a naive implementation that they must equal.

`rollout` costs one pass over the prompt. While the window fills, a new frame costs M + 1 passes over one frame; when
the window slides, one pass over the window and M - 1 passes over one frame. The release makes M passes over the whole
window for every frame, and so does `rollout_naive`. How a frame is decoded is in `decoding`; everything here serves
both variants.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, require
from hma_jax.config.base import require_shapes
from hma_jax.generation import steps
from hma_jax.generation.cache import FrameCache, Window, cut
from hma_jax.generation.decoding import Frame, blank_frame, decode_frame
from hma_jax.kernels.random import fold_in_each
from hma_jax.model.given import Array, as_frames, require_keys, require_known
from hma_jax.model.hma import HMA


class Sequences(NamedTuple):
    """The action sequences of B examples, R of each example in a row, with their marks, robots and keys."""

    chunks: jax.Array  # raw [B R, T, U]
    hidden: jax.Array | None  # [B R, T]
    robots: jax.Array  # [B R]
    keys: jax.Array  # [B R]

    def window(self, model: HMA, first: int | jax.Array, size: int) -> Window:
        """The window of `size` frames whose first position is frame `first`."""
        hidden = None if self.hidden is None else cut(self.hidden, first, size)
        return Window.over(model, cut(self.chunks, first, size), hidden, self.robots)

    def keys_at(self, t: jax.Array) -> jax.Array:
        """The keys of frame t."""
        return fold_in_each(self.keys, t)


def rollout(
    model: HMA,
    prompt: Array,
    actions_BRTU: Array,
    embodiment_B: Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    action_hidden_BT: Array | None = None,
) -> jax.Array:
    """Continues each prompt, [B, T', S] or [B, T', S, C], under R action sequences.

    Returns the frames after the prompt, [B, R, frames - T', S] (or with C); with the prompt there are as many frames as
    chunks. Past T frames the window slides as `decode.slide` says; of a prompt longer than T - 1 frames only the last T
    - 1 are seen. The sequences of one example may differ from the chunk of the last prompt frame on; everything before
    is read from the first sequence and computed once. All R sequences use the same random numbers (a function of the
    example's key and the frame), so that they differ only by their actions. `action_hidden_BT` marks chunks that the
    model is not shown because it was trained without them (`objective.masking.hidden_at_inference`). Raises ConfigError
    for shapes and types that do not fit the model or each other, and, where arrays are not traced, for unknown ids and
    robots and for actions that are not finite.
    """
    _require_shapes(model, prompt, actions_BRTU, embodiment_B, key_B, action_hidden_BT)
    require_known(model.config, model.table, prompt, actions_BRTU, embodiment_B)
    prompt = as_frames(model.config, prompt)
    prompt, actions_BRTU, action_hidden_BT = _recent(model, prompt, actions_BRTU, action_hidden_BT)
    batch, repeats, frames, _ = actions_BRTU.shape
    size = min(frames, model.config.frames)
    sequences = Sequences(
        actions_BRTU.reshape(batch * repeats, frames, -1),
        None if action_hidden_BT is None else jnp.repeat(action_hidden_BT, repeats, axis=0),
        jnp.repeat(embodiment_B, repeats, axis=0),
        jnp.repeat(key_B, repeats, axis=0),
    )
    # All prompt frames but the last, whose chunk may differ between sequences.
    shared = Window.over(model, actions_BRTU[:, 0], action_hidden_BT, embodiment_B).start(prompt[:, :-1], size - 1)
    layers = jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=1), shared.layers)
    seen = jnp.repeat(prompt, repeats, axis=0)
    cache, new = _fill(model, sequences, FrameCache(layers, shared.valid), seen, size, decode)
    if frames > size:
        past = jnp.concatenate([seen, new], axis=1)[:, 1 - size :]
        further = _slide if decode.slide == "exact" else _stream
        more = further(model, sequences, cache, past, jnp.arange(size, frames), decode)
        new = jnp.concatenate([new, more], axis=1)
    return new.reshape(batch, repeats, -1, *prompt.shape[2:])


def _fill(
    model: HMA, sequences: Sequences, cache: FrameCache, prompt: jax.Array, size: int, decode: DecodeConfig
) -> tuple[FrameCache, jax.Array]:
    """(cache, frames after the prompt [B R, ...]) up to the end of the first window."""
    window = sequences.window(model, 0, size)

    def step(carry: tuple[FrameCache, jax.Array], t: jax.Array):
        cache, frame = steps.fill(window, *carry, t, sequences.keys_at(t), decode)
        return (cache, frame), frame

    (cache, _), new = jax.lax.scan(step, (cache, prompt[:, -1]), jnp.arange(prompt.shape[1], size))
    return cache, jnp.moveaxis(new, 0, 1)


def _slide(
    model: HMA, sequences: Sequences, cache: FrameCache, past: jax.Array, times: jax.Array, decode: DecodeConfig
) -> jax.Array:
    """Exact frames at `times` past the first window; `past` are the T - 1 before them."""
    del cache
    size = past.shape[1] + 1

    def step(past: jax.Array, t: jax.Array):
        window = sequences.window(model, t + 1 - size, size)
        frame = steps.slide(window, past, sequences.keys_at(t), decode)
        return jnp.concatenate([past[:, 1:], frame[:, None]], axis=1), frame

    return jnp.moveaxis(jax.lax.scan(step, past, times)[1], 0, 1)


def _stream(
    model: HMA, sequences: Sequences, cache: FrameCache, past: jax.Array, times: jax.Array, decode: DecodeConfig
) -> jax.Array:
    """The same frames as `_slide`, approximately, from the cache of the first window."""
    size = past.shape[1] + 1

    def step(carry: tuple[FrameCache, jax.Array], t: jax.Array):
        window = sequences.window(model, t + 1 - size, size)
        cache, frame = steps.stream(window, *carry, t, sequences.keys_at(t), decode)
        return (cache, frame), frame

    return jnp.moveaxis(jax.lax.scan(step, (cache, past[:, -1]), times)[1], 0, 1)


def rollout_naive(
    model: HMA,
    prompt: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    action_hidden_BT: jax.Array | None = None,
) -> jax.Array:
    """What `rollout` must equal: every unmasking step is a pass over the whole window."""
    prompt, actions_BRTU, action_hidden_BT = _recent(model, prompt, actions_BTU[:, None], action_hidden_BT)
    batch, _, frames, _ = actions_BRTU.shape
    count = prompt.shape[1]
    size = min(frames, model.config.frames)
    blank = blank_frame(model.config, batch)
    future = [blank.values[:, None].astype(prompt.dtype)] * (frames - count)

    def next_frame(known: jax.Array, t: jax.Array):
        first = jnp.maximum(t + 1 - size, 0)
        aligned = model.align(cut(actions_BRTU[:, 0], first, size))
        recorded = None if action_hidden_BT is None else cut(action_hidden_BT, first, size)
        hidden = model.align_hidden(recorded, (batch, size))

        def predict(frame: Frame) -> jax.Array:
            values = cut(known, first, size)
            unknown = jnp.broadcast_to(jnp.arange(size)[None, :, None] >= t - first, values.shape[:3])
            values = values.at[:, t - first].set(frame.values)
            unknown = unknown.at[:, t - first].set(frame.masked)
            return model(values, unknown, aligned, embodiment_B, action_hidden_BT=hidden).token_outputs[:, t - first]

        frame = decode_frame(model, predict(blank), predict, fold_in_each(key_B, t), decode)
        return known.at[:, t].set(frame), None

    known, _ = jax.lax.scan(next_frame, jnp.concatenate([prompt, *future], axis=1), jnp.arange(count, frames))
    return known[:, count:]


def _require_shapes(
    model: HMA,
    prompt: Array,
    actions_BRTU: Array,
    embodiment_B: Array,
    key_B: jax.Array,
    action_hidden_BT: Array | None,
) -> None:
    batch, *frames = jnp.shape(prompt)
    token = [*model.config.frame_shape]
    examples, *sequences = jnp.shape(actions_BRTU)
    fits = frames[1:] == token and len(sequences) == 3 and sequences[2] == model.table.action_width
    require(
        fits and {(batch,)} == {(examples,), jnp.shape(embodiment_B), jnp.shape(key_B)[:1]},
        f"a rollout takes a prompt [B, T', {', '.join(map(str, token))}], actions [B, R, T, "
        f"{model.table.action_width}] (all chunks of a frame, padded with zeros), B robots and B keys; got "
        + ", ".join(str(jnp.shape(x)) for x in (prompt, actions_BRTU, embodiment_B, key_B)),
    )
    require_keys(key_B, batch)
    if action_hidden_BT is not None:
        require_shapes("a rollout takes", {"hidden": action_hidden_BT}, {"hidden": (batch, sequences[1])})


def _recent(
    model: HMA, prompt: Array, actions_BRTU: Array, action_hidden_BT: Array | None
) -> tuple[Array, Array, Array | None]:
    """Prompt, chunks and marks without the prompt frames that no new frame sees. Raises ConfigError."""
    count, frames = prompt.shape[1], actions_BRTU.shape[2]
    require(
        1 <= count < frames,
        f"a rollout needs at least 1 prompt frame, got {count}, and action chunks for more frames than the prompt "
        f"has, got {frames}",
    )
    require(model.config.frames > 1, "a model with model.frames 1 cannot generate frames: it needs at least 2")
    old = max(count - (model.config.frames - 1), 0)
    return prompt[:, old:], actions_BRTU[:, :, old:], None if action_hidden_BT is None else action_hidden_BT[:, old:]
