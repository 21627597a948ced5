"""Whole rollouts in one compiled call, and the oracle they must equal.

`rollout` costs one pass over the prompt; while the window fills, M + 1 one-frame passes per new
frame; when it slides, one window pass and M - 1 one-frame passes, where the release runs the
whole window M times per frame. `rollout_naive` does it the release's way. How a frame is filled
is `decoding`'s business; everything here serves both variants.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, require
from hma_jax.generation.decoding import Frame, blank_frame, decode_frame
from hma_jax.generation.window import Window
from hma_jax.model.hma import HMA


def rollout(
    model: HMA,
    prompt: jax.Array,
    actions_BRTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    hidden_BT: jax.Array | None = None,
) -> jax.Array:
    """Continues each prompt, [B, T', S] or [B, T', S, C], under R action sequences.

    Returns the frames after the prompt, [B, R, frames - T', S] (or with C), for as many frames as
    there are chunks: past the model's window of T it slides as `decode.slide` says, and of a
    longer prompt the last T - 1 frames are seen. The sequences of one example may differ from the
    chunk of the last prompt frame on; what comes before is read from the first sequence and
    computed once. All R sequences use the same random numbers (a function of the example's key
    and the frame), so a difference between them is the actions' doing. `hidden_BT` marks recorded
    chunks that the model is not shown.
    """
    prompt, actions_BRTU, hidden_BT = _recent(model, prompt, actions_BRTU, hidden_BT)
    batch, repeats, frames, _ = actions_BRTU.shape
    count, size = prompt.shape[1], min(frames, model.config.frames)
    flat = lambda x: None if x is None else jnp.repeat(x, repeats, axis=0)  # noqa: E731  [B, ...] -> [B R, ...]
    chunks, hidden, robots, keys = (
        actions_BRTU.reshape(batch * repeats, frames, -1),
        flat(hidden_BT),
        flat(embodiment_B),
        flat(key_B),
    )

    def window(first: int | jax.Array) -> Window:
        """The one whose first position is frame `first`."""
        cut = lambda x: None if x is None else jax.lax.dynamic_slice_in_dim(x, first, size, axis=1)  # noqa: E731
        return Window.over(model, cut(chunks), cut(hidden), robots)

    def frame_keys(t: jax.Array) -> jax.Array:
        return jax.vmap(lambda k: jax.random.fold_in(k, t))(keys)

    # All prompt frames but the last, whose chunk may differ between sequences.
    shared = Window.over(model, actions_BRTU[:, 0], hidden_BT, embodiment_B)
    cache = jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=1), shared.prefill(prompt[:, :-1], size - 1))
    filling = window(0)

    def fill(carry, t):
        cache, frame = filling.fill(*carry, t, frame_keys(t), decode)
        return (cache, frame), frame

    def stream(carry, t):
        cache, frame = window(t + 1 - size).stream(*carry, t, frame_keys(t), decode)
        return (cache, frame), frame

    def slide(past, t):
        frame = window(t + 1 - size).slide(past, frame_keys(t), decode)
        return jnp.concatenate([past[:, 1:], frame[:, None]], axis=1), frame

    carry = (cache, flat(prompt[:, -1]))
    carry, new = jax.lax.scan(fill, carry, jnp.arange(count, size))
    new = jnp.moveaxis(new, 0, 1)
    if frames > size:
        if decode.slide == "exact":
            carry = jnp.concatenate([flat(prompt), new], axis=1)[:, 1 - size :]
        _, more = jax.lax.scan(slide if decode.slide == "exact" else stream, carry, jnp.arange(size, frames))
        new = jnp.concatenate([new, jnp.moveaxis(more, 0, 1)], axis=1)
    return new.reshape(batch, repeats, -1, *prompt.shape[2:])


def rollout_naive(
    model: HMA,
    prompt: jax.Array,
    actions_BTU: jax.Array | None,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    frames: int | None = None,
    hidden_BT: jax.Array | None = None,
) -> jax.Array:
    """What `rollout` must equal: the whole window again for every look at a frame.

    Without actions (None) there are neither action tokens nor conditioning, and `frames` says
    how many to fill up to.
    """
    if actions_BTU is None:
        actions_BRTU = jnp.zeros((len(prompt), 1, frames, 0))
    else:
        actions_BRTU = actions_BTU[:, None]
    prompt, actions_BRTU, hidden_BT = _recent(model, prompt, actions_BRTU, hidden_BT)
    frames, count = actions_BRTU.shape[2], prompt.shape[1]
    size = min(frames, model.config.frames)
    blank = blank_frame(model.config, len(prompt))
    future = [blank.values[:, None].astype(prompt.dtype)] * (frames - count)

    def next_frame(known: jax.Array, t: jax.Array):
        first = jnp.maximum(t + 1 - size, 0)
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, size, axis=1)  # noqa: E731
        aligned = hidden = None
        if actions_BTU is not None:
            aligned = model.align(cut(actions_BRTU[:, 0]))
            hidden = model.align_hidden(None if hidden_BT is None else cut(hidden_BT), (len(prompt), size))

        def look(frame: Frame) -> jax.Array:
            values = cut(known)
            unknown = jnp.broadcast_to(jnp.arange(size)[None, :, None] >= t - first, values.shape[:3])
            values = values.at[:, t - first].set(frame.values)
            unknown = unknown.at[:, t - first].set(frame.masked)
            return model(values, unknown, aligned, embodiment_B, hidden_BT=hidden).frames[:, t - first]

        frame_keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(key_B)
        frame = decode_frame(model, look(blank), look, frame_keys, decode)
        return known.at[:, t].set(frame), None

    known, _ = jax.lax.scan(next_frame, jnp.concatenate([prompt, *future], axis=1), jnp.arange(count, frames))
    return known[:, count:]


def _recent(
    model: HMA, prompt: jax.Array, actions_BRTU: jax.Array, hidden_BT: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Prompt, chunks and marks without the prompt frames that no new frame sees. Raises ConfigError."""
    count, frames = prompt.shape[1], actions_BRTU.shape[2]
    require(
        1 <= count < frames,
        f"a rollout from a prompt of {count} frames needs chunks for more than that, got {frames}",
    )
    require(model.config.frames > 1, "a model of one frame cannot continue anything")
    old = max(count - (model.config.frames - 1), 0)
    return prompt[:, old:], actions_BRTU[:, :, old:], None if hidden_BT is None else hidden_BT[:, old:]
