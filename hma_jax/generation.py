"""From prompt to frames: iterative unmasking, frame by frame, over a temporal cache.

Spatial attention stays inside a frame and temporal attention is causal, so all that later
frames need of a finished frame are its temporal keys and values. A rollout therefore costs
one pass over the prompt and M + 1 one-frame passes per new frame, where the release runs the
whole window M times per frame. `rollout_naive` does it the release's way and is the oracle.

Frames stay inside the window of T positions the model was trained on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp

from hma_jax.config import require
from hma_jax.model.hma import HMA, causal, compose
from hma_jax.model.trunk import TemporalCache


@dataclass(frozen=True)
class DecodeConfig:
    """How a frame is unmasked.

    `temperature` divides logits; 0 takes the most likely entry of each factor. DIFFERS: the
    release divides probabilities, which a renormalising draw ignores (reference section 3.2).
    """

    unmask_steps: int = 2  # M
    temperature: float = 0.0
    order: Literal["random", "confidence"] = "random"

    def __post_init__(self):
        require(self.unmask_steps >= 1, f"decode.unmask_steps must be at least 1, got {self.unmask_steps}")
        require(self.temperature >= 0, f"decode.temperature must not be negative, got {self.temperature}")


def masked_counts(steps: int, tokens: int) -> list[int]:
    """Positions still masked after each step but the last: ceil(cos(pi/2 (k+1)/M) S)."""
    return [math.ceil(math.cos(math.pi / 2 * (k + 1) / steps) * tokens) for k in range(steps - 1)]


def sample_tokens(
    logits_BSQV: jax.Array, key_B: jax.Array, temperature: float
) -> tuple[jax.Array, jax.Array]:
    """(ids [B, S], confidence [B, S]): factors are drawn independently, confidence is the
    product of the chosen probabilities."""
    if temperature == 0:
        ids = jnp.argmax(logits_BSQV, axis=-1)
    else:
        ids = jax.vmap(jax.random.categorical)(key_B, logits_BSQV / temperature)
    probabilities = jax.nn.softmax(logits_BSQV, axis=-1)
    chosen = jnp.take_along_axis(probabilities, ids[..., None], axis=-1)[..., 0]
    return compose(ids, logits_BSQV.shape[-1]).astype(jnp.int32), jnp.prod(chosen, axis=-1)


def unmask(
    frame_BS: jax.Array, sampled_BS: jax.Array, score_BS: jax.Array, keep: int, mask_id: int
) -> jax.Array:
    """Fills masked positions of a frame but for the `keep` with the lowest score.

    Known positions are never drawn again.
    """
    masked = frame_BS == mask_id
    filled = jnp.where(masked, sampled_BS, frame_BS)
    if keep == 0:
        return filled
    score = jnp.where(masked, score_BS, jnp.inf)
    rank = jnp.argsort(jnp.argsort(score, axis=-1), axis=-1)
    return jnp.where(rank < keep, mask_id, filled)


def _decode_frame(
    first_logits: jax.Array, next_logits, key_B: jax.Array, mask_id: int, decode: DecodeConfig
) -> jax.Array:
    """Unmasks one frame; `next_logits(frame_BS)` looks at it again between steps."""
    batch, tokens = first_logits.shape[:2]
    frame = jnp.full((batch, tokens), mask_id, jnp.int32)
    logits = first_logits
    for step, keep in enumerate([*masked_counts(decode.unmask_steps, tokens), 0]):
        keys = jax.vmap(lambda k, s=step: jax.random.split(jax.random.fold_in(k, s)))(key_B)
        sampled, confidence = sample_tokens(logits, keys[:, 0], decode.temperature)
        score = confidence
        if decode.order == "random":
            score = jax.vmap(lambda k: jax.random.uniform(k, (tokens,)))(keys[:, 1])
        frame = unmask(frame, sampled, score, keep, mask_id)
        if keep:
            logits = next_logits(frame)
    return frame


def rollout(
    model: HMA,
    prompt_BTS: jax.Array,
    actions_BRTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> jax.Array:
    """Continues each prompt under R action sequences: tokens [B, R, T - prompt, S].

    The sequences of one example may differ from the chunk of the last prompt frame on; what
    comes before is read from the first sequence and computed once. All R sequences use the
    same random numbers (a function of the example's key and the frame), so a difference
    between them is the actions' doing.
    """
    config = model.config
    batch, repeats, frames, _ = actions_BRTU.shape
    prompt = prompt_BTS.shape[1]
    require(
        1 <= prompt < frames <= config.frames,
        f"a rollout of {frames} frames from a prompt of {prompt} does not fit a window of {config.frames}",
    )
    flat = lambda x: jnp.repeat(x, repeats, axis=0)  # noqa: E731  [B, ...] -> [B * R, ...]
    aligned_BRTU = model.align(actions_BRTU)
    actions = aligned_BRTU.reshape(batch * repeats, frames, -1)
    embodiment, keys = flat(embodiment_B), flat(key_B)

    # Keys and values of all prompt frames but the last, with room for the rest.
    past = None
    if prompt > 1:
        _, past = model(prompt_BTS[:, :-1], aligned_BRTU[:, 0, : prompt - 1], embodiment_B, keep=True)
    room = frames - 1
    cache = _make_room(model, past, batch, room)
    cache = jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=1), cache)

    def next_frame(carry: tuple[TemporalCache, jax.Array], t: jax.Array):
        cache, last_BS = carry
        # Committing the finished frame t - 1 and looking at the masked frame t is one pass.
        both = jnp.stack([last_BS, jnp.full_like(last_BS, config.mask_id)], axis=1)
        pair = jax.lax.dynamic_slice_in_dim(actions, t - 1, 2, axis=1)
        visible = jnp.concatenate(
            [jnp.broadcast_to(jnp.arange(room) < t - 1, (2, room)), causal(2)], axis=1
        )
        logits, new = model(both, pair, embodiment, visible=visible, first=t - 1, past=cache, keep=True)
        cache = jax.tree.map(
            lambda c, n: jax.lax.dynamic_update_slice_in_dim(c, n[:, :, :1], t - 1, axis=2), cache, new
        )
        seen = jnp.append(jnp.arange(room) < t, True)[None]

        def look(frame_BS: jax.Array) -> jax.Array:
            args = (frame_BS[:, None], pair[:, 1:], embodiment)
            return model(*args, visible=seen, first=t, past=cache)[0][:, 0]

        frame_keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(keys)
        frame = _decode_frame(logits[:, 1], look, frame_keys, config.mask_id, decode)
        return (cache, frame), frame

    steps = jnp.arange(prompt, frames)
    _, new_frames = jax.lax.scan(next_frame, (cache, flat(prompt_BTS[:, -1])), steps)
    return jnp.moveaxis(new_frames, 0, 1).reshape(batch, repeats, frames - prompt, -1)


def _make_room(model: HMA, past: TemporalCache | None, batch: int, room: int) -> TemporalCache:
    config = model.config
    shape = (config.layers, batch, room, config.frame_tokens, config.heads, config.head_width)
    empty = jnp.zeros(shape, jnp.dtype(config.compute_dtype))
    if past is None:
        return TemporalCache(empty, empty)
    return jax.tree.map(lambda x: jax.lax.dynamic_update_slice(empty, x, (0,) * 6), past)


def rollout_naive(
    model: HMA,
    prompt_BTS: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> jax.Array:
    """What `rollout` must equal: the whole window again for every look at a frame."""
    mask_id, frames = model.config.mask_id, actions_BTU.shape[1]
    actions = model.align(actions_BTU)
    batch, prompt, tokens = prompt_BTS.shape
    future = jnp.full((batch, frames - prompt, tokens), mask_id, jnp.int32)
    window = jnp.concatenate([prompt_BTS, future], axis=1)

    def next_frame(window_BTS: jax.Array, t: jax.Array):
        def look(frame_BS: jax.Array) -> jax.Array:
            return model(window_BTS.at[:, t].set(frame_BS), actions, embodiment_B)[0][:, t]

        frame_keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(key_B)
        frame = _decode_frame(look(window_BTS[:, t]), look, frame_keys, mask_id, decode)
        return window_BTS.at[:, t].set(frame), None

    window, _ = jax.lax.scan(next_frame, window, jnp.arange(prompt, frames))
    return window[:, prompt:]


def next_frame_logits(
    model: HMA, tokens_BTS: jax.Array, actions_BTU: jax.Array, embodiment_B: jax.Array
) -> jax.Array:
    """Logits [B, T - 1, S, Q, V] of frames 1 .. T-1, each wholly masked after its true past.

    One pass over 2 (T - 1) frames, the true ones and the masked ones side by side, where the
    official evaluation makes T - 1 passes over the window (reference section 6.2).
    """
    frames = tokens_BTS.shape[1]
    true = tokens_BTS[:, :-1]
    both = jnp.concatenate([true, jnp.full_like(true, model.config.mask_id)], axis=1)
    aligned = model.align(actions_BTU)
    actions = jnp.concatenate([aligned[:, :-1], aligned[:, 1:]], axis=1)
    positions = jnp.concatenate([jnp.arange(frames - 1), jnp.arange(1, frames)])
    past, itself = causal(frames - 1), jnp.eye(frames - 1, dtype=bool)
    # A masked frame t sees the true frames before it and itself; nobody sees a masked frame.
    visible = jnp.block([[past, jnp.zeros_like(past)], [past, itself]])
    logits, _ = model(both, actions, embodiment_B, visible=visible, positions=positions)
    return logits[:, frames - 1 :]
