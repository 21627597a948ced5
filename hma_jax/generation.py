"""From prompt to frames: iterative unmasking, frame by frame, over a temporal cache.

Spatial attention stays inside a frame and temporal attention is causal, so all that later
frames need of a finished frame is in its cache. A rollout therefore costs one pass over the
prompt and M + 1 one-frame passes per new frame, where the release runs the whole window M
times per frame. `rollout_naive` does it the release's way and is the oracle. How a frame is
filled is `decoding`'s business; everything here serves both variants.

Frames stay inside the window of T positions the model was trained on.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, require
from hma_jax.decoding import Frame, blank_frame, decode_frame
from hma_jax.diffusion import make_process, respace, sample_with_key
from hma_jax.model.hma import HMA, Outputs, causal
from hma_jax.model.trunk import TemporalCache


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

    Returns frames [B, R, T - T', S] (or with C). The sequences of one example may differ from
    the chunk of the last prompt frame on; what comes before is read from the first sequence and
    computed once. All R sequences use the same random numbers (a function of the example's key
    and the frame), so a difference between them is the actions' doing. `hidden_BT` marks
    recorded chunks that the model is not shown.
    """
    batch, repeats, frames, _ = actions_BRTU.shape
    count = _check_prompt(model, prompt, frames)
    flat = lambda x: None if x is None else jnp.repeat(x, repeats, axis=0)  # noqa: E731  [B, ...] -> [B R, ...]
    aligned = model.align(actions_BRTU)
    hidden = model.align_hidden(hidden_BT, (batch, frames))
    cache = None
    if count > 1:  # all prompt frames but the last, whose chunk may differ between sequences
        early = None if hidden is None else hidden[:, : count - 1]
        args = (prompt[:, :-1], None, aligned[:, 0, : count - 1], embodiment_B)
        cache = model(*args, hidden_BT=early, keep=True).cache
    cache = _make_room(model, cache, batch, frames - 1)
    window = _Window(model, aligned.reshape(batch * repeats, frames, -1), flat(hidden), flat(embodiment_B))
    cache = jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=1), cache)
    keys = flat(key_B)

    def next_frame(carry: tuple[TemporalCache, jax.Array], t: jax.Array):
        cache, last = carry
        out, cache = window.commit_and_look(cache, last, t)
        look = lambda frame: window.look(cache, frame, t)  # noqa: E731
        frame_keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(keys)
        frame = decode_frame(model, out.frames[:, 1], look, frame_keys, decode)
        return (cache, frame), frame

    _, new = jax.lax.scan(next_frame, (cache, flat(prompt[:, -1])), jnp.arange(count, frames))
    return jnp.moveaxis(new, 0, 1).reshape(batch, repeats, frames - count, *prompt.shape[2:])


class _Window(NamedTuple):
    """What all one-frame passes of a rollout share: aligned actions and what is shown of them."""

    model: HMA
    actions_BTU: jax.Array
    hidden_BT: jax.Array | None
    embodiment_B: jax.Array

    def commit_and_look(
        self, cache: TemporalCache, last: jax.Array, t: jax.Array
    ) -> tuple[Outputs, TemporalCache]:
        """One pass over the finished frame t - 1, which enters the cache, and the masked frame t."""
        blank = blank_frame(self.model.config, len(last))
        values = jnp.stack([last, blank.values.astype(last.dtype)], axis=1)
        masked = jnp.stack([jnp.zeros_like(blank.masked), blank.masked], axis=1)
        room = cache.time[0].shape[2]
        seen = jnp.broadcast_to(jnp.arange(room) < t - 1, (2, room))
        visible = jnp.concatenate([seen, causal(2)], axis=1)
        out = self.pass_over(values, masked, t - 1, cache, visible)
        return out, write_cache(cache, out.cache, t - 1)

    def look(self, cache: TemporalCache, frame: Frame, t: jax.Array) -> jax.Array:
        """What the model says of frame t, given those before it."""
        seen = jnp.append(jnp.arange(cache.time[0].shape[2]) < t, True)[None]
        return self.pass_over(frame.values[:, None], frame.masked[:, None], t, cache, seen).frames[:, 0]

    def pass_over(
        self, values: jax.Array, masked: jax.Array, first: jax.Array, cache: TemporalCache, visible: jax.Array
    ) -> Outputs:
        count = values.shape[1]
        part = lambda x: None if x is None else jax.lax.dynamic_slice_in_dim(x, first, count, axis=1)  # noqa: E731
        return self.model(
            values,
            masked,
            part(self.actions_BTU),
            self.embodiment_B,
            hidden_BT=part(self.hidden_BT),
            visible=visible,
            first=first,
            past=cache,
            keep=True,
        )


def write_cache(cache: TemporalCache, new: TemporalCache, t: jax.Array) -> TemporalCache:
    """`cache` with the first frame of `new` at position t."""
    put = lambda c, n: jax.lax.dynamic_update_slice_in_dim(c, n[:, :, :1], t, axis=2)  # noqa: E731
    return jax.tree.map(put, cache, new)


def _make_room(model: HMA, past: TemporalCache | None, batch: int, room: int) -> TemporalCache:
    """`past` with `room` positions, or that many empty ones."""

    def one_frame() -> TemporalCache:
        blank = blank_frame(model.config, batch)
        actions = jnp.zeros((batch, 1, model.table.action_width))
        robots = jnp.zeros(batch, jnp.int32)
        return model(blank.values[:, None], blank.masked[:, None], actions, robots, keep=True).cache

    shapes = jax.eval_shape(one_frame)
    empty = jax.tree.map(lambda x: jnp.zeros((*x.shape[:2], room, *x.shape[3:]), x.dtype), shapes)
    if past is None:
        return empty
    return jax.tree.map(lambda e, x: jax.lax.dynamic_update_slice(e, x, (0,) * x.ndim), empty, past)


def _check_prompt(model: HMA, prompt: jax.Array, frames: int) -> int:
    count = prompt.shape[1]
    require(
        1 <= count < frames <= model.config.frames,
        f"a rollout of {frames} frames from a prompt of {count} does not fit a window of {model.config.frames}",
    )
    return count


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
    frames = frames or actions_BTU.shape[1]
    count = _check_prompt(model, prompt, frames)
    aligned = None if actions_BTU is None else model.align(actions_BTU)
    hidden = None if actions_BTU is None else model.align_hidden(hidden_BT, (len(prompt), frames))
    blank = blank_frame(model.config, len(prompt))
    future = [blank.values[:, None].astype(prompt.dtype)] * (frames - count)
    window = jnp.concatenate([prompt, *future], axis=1)

    def next_frame(window: jax.Array, t: jax.Array):
        def look(frame: Frame) -> jax.Array:
            unknown = jnp.broadcast_to(jnp.arange(frames)[None, :, None] >= t, window.shape[:3])
            args = (window.at[:, t].set(frame.values), unknown.at[:, t].set(frame.masked), aligned, embodiment_B)
            return model(*args, hidden_BT=hidden).frames[:, t]

        frame_keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(key_B)
        frame = decode_frame(model, look(blank), look, frame_keys, decode)
        return window.at[:, t].set(frame), None

    window, _ = jax.lax.scan(next_frame, window, jnp.arange(count, frames))
    return window[:, count:]


def next_frame_outputs(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None = None,
) -> jax.Array:
    """What the model says of frames 1 .. T-1, each wholly masked after its true past: logits
    [B, T - 1, S, Q, V] or conditions [B, T - 1, S, D].

    One pass over 2 (T - 1) frames, the true ones and the masked ones side by side, where the
    official evaluation makes T - 1 passes over the window (reference section 6.2).
    """
    count = frames.shape[1] - 1
    both = jnp.concatenate([frames[:, :-1]] * 2, axis=1)
    masked = jnp.broadcast_to((jnp.arange(2 * count) >= count)[None, :, None], both.shape[:3])
    twice = lambda x: jnp.concatenate([x[:, :-1], x[:, 1:]], axis=1)  # noqa: E731
    actions = twice(model.align(actions_BTU))
    hidden = model.align_hidden(hidden_BT, frames.shape[:2])
    hidden = None if hidden is None else twice(hidden)
    positions = jnp.concatenate([jnp.arange(count), jnp.arange(1, count + 1)])
    past, itself = causal(count), jnp.eye(count, dtype=bool)
    # A masked frame t sees the true frames before it and itself; nobody sees a masked frame.
    visible = jnp.block([[past, jnp.zeros_like(past)], [past, itself]])
    out = model(
        both, masked, actions, embodiment_B, hidden_BT=hidden, visible=visible, positions=positions
    )
    return out.frames[:, count:]


# --- Actions ---------------------------------------------------------------------------------


def predict_actions(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    causally: bool = True,
) -> jax.Array:
    """Raw chunks [B, T, U] read off every frame, where those marked hidden are not shown.

    As a policy a frame's chunk is predicted from frames up to it and what is shown of the
    actions; with `causally` False from the whole window (inverse dynamics). Padding is 0.
    """
    count = frames.shape[1]
    visible = None if causally else jnp.ones((count, count), bool)
    hidden = model.align_hidden(hidden_BT, frames.shape[:2])
    out = model(frames, None, model.align(actions_BTU), embodiment_B, hidden_BT=hidden, visible=visible)
    return read_actions(model, out, embodiment_B, key_B, decode)


def predict_next_actions(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> jax.Array:
    """Raw chunks [B, T, U]: what the policy would do at every frame of a recorded window, having
    seen the frames up to it and all actions before.

    One pass: with causal alignment no frame is shown its own chunk; otherwise every frame stands
    beside a copy of itself whose action is hidden, as in `next_frame_outputs`.
    """
    batch, count = frames.shape[:2]
    if model.config.action_alignment == "causal":
        nothing = jnp.zeros((batch, count), bool)
        return predict_actions(model, frames, actions_BTU, embodiment_B, nothing, key_B, decode)
    twice = lambda x: jnp.concatenate([x, x], axis=1)  # noqa: E731
    hidden = jnp.broadcast_to(jnp.arange(2 * count) >= count, (batch, 2 * count))
    past, before = causal(count), jnp.tril(jnp.ones((count, count), bool), -1)
    visible = jnp.block([[past, jnp.zeros_like(past)], [before, jnp.eye(count, dtype=bool)]])
    positions = jnp.concatenate([jnp.arange(count)] * 2)
    out = model(
        twice(frames),
        None,
        twice(actions_BTU),
        embodiment_B,
        hidden_BT=hidden,
        visible=visible,
        positions=positions,
    )
    own = out._replace(actions=None if out.actions is None else out.actions[:, count:])
    return read_actions(model, own, embodiment_B, key_B, decode)


def read_actions(
    model: HMA, out: Outputs, embodiment_B: jax.Array, key_B: jax.Array, decode: DecodeConfig
) -> jax.Array:
    """Raw chunks [B, T, U] from what a pass says of actions. Raises ConfigError without a head."""
    require(
        model.action_head is not None and out.actions is not None,
        "the model predicts no actions; train one with model.action_heads=true and a conditioning with concat",
    )
    config = model.config.diffusion
    if config:
        process = respace(make_process(config.steps), decode.sampler.steps)
        shape = (*out.actions.shape[:2], model.table.action_width)
        # In training padding and dead dimensions are 0 also when noised.
        alive_BTU = jnp.asarray(model.table.alive())[embodiment_B][:, None]
        head = model.action_head
        network = lambda x, t: head(jnp.where(alive_BTU, x, 0), t, out.actions, embodiment_B)  # noqa: E731
        normalised = sample_with_key(network, key_B, shape, process, decode.sampler, config.clip)
    else:
        normalised = model.action_head(out.actions, embodiment_B)
    return model.table.unnormalise(normalised, embodiment_B)


def rollout_policy(
    model: HMA,
    prompt: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> tuple[jax.Array, jax.Array]:
    """The model acts in its own dreams: (new frames [B, T - T', S (, C)], raw chunks [B, T, U]).

    `actions_BTU` are recorded for the T' - 1 transitions within the prompt; from its last frame
    on the model chooses: it reads a chunk off the frame it sees and predicts what follows. The
    last returned chunk, after the last frame, is as given.
    """
    frames = actions_BTU.shape[1]
    count = _check_prompt(model, prompt, frames)
    shape = (len(prompt), frames)

    def hidden_from(t: jax.Array | int) -> jax.Array:
        """Frames that are shown no action while the chunks from t on are unknown."""
        return model.align_hidden(jnp.broadcast_to(jnp.arange(frames) >= t, shape), shape)

    cache = None
    if count > 1:
        past, hidden = model.align(actions_BTU)[:, : count - 1], hidden_from(count - 1)[:, : count - 1]
        cache = model(prompt[:, :-1], None, past, embodiment_B, hidden_BT=hidden, keep=True).cache
    cache = _make_room(model, cache, len(prompt), frames - 1)
    nothing_masked = jnp.zeros((len(prompt), 1, model.config.tokens), bool)

    def next_frame(carry: tuple[TemporalCache, jax.Array, jax.Array], t: jax.Array):
        cache, last, chunks = carry
        # The chunk after frame t - 1, read with that chunk hidden.
        act = _Window(model, model.align(chunks), hidden_from(t - 1), embodiment_B)
        seen = jnp.append(jnp.arange(cache.time[0].shape[2]) < t - 1, True)[None]
        out = act.pass_over(last[:, None], nothing_masked, t - 1, cache, seen)
        keys = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, t)))(key_B)
        chunk = read_actions(model, out, embodiment_B, keys[:, 0], decode)
        chunks = jax.lax.dynamic_update_slice_in_dim(chunks, chunk, t - 1, axis=1)
        # Now it is known; the one after frame t is not.
        step = _Window(model, model.align(chunks), hidden_from(t), embodiment_B)
        out, cache = step.commit_and_look(cache, last, t)
        frame = decode_frame(model, out.frames[:, 1], lambda f: step.look(cache, f, t), keys[:, 1], decode)
        return (cache, frame, chunks), frame

    carry = (cache, prompt[:, -1], actions_BTU)
    (_, _, chunks), new = jax.lax.scan(next_frame, carry, jnp.arange(count, frames))
    return jnp.moveaxis(new, 0, 1), chunks
