"""Many simulated episodes at once, each with its own length: a batch of sessions of one example each.

Every array of `Episodes` has a leading axis B, so an episode may start, wait, be copied or be rewound independently of
the others. The computation is that of `session` for one example, under `jax.vmap`.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.session import Phase, Session, advance, start
from hma_jax.model.hma import HMA

T = TypeVar("T")

Episodes = Session
"""A `Session` of batch 1 per episode, with the episodes along a leading axis of every array: `count` is [B]."""


def start_each(
    model: HMA,
    frames: jax.Array,
    chunks_BTU: jax.Array,
    embodiment_B: jax.Array,
    given_B: jax.Array,
    count_B: jax.Array,
    *,
    hidden: bool = False,
) -> Episodes:
    """Episodes that have seen the first `given_B` (at least 1 each) of `frames` [B, T - 1, S (, C)].

    `chunks_BTU` [B, T - 2, U] are the chunks executed between the frames; frames and chunks after the given ones are
    arbitrary. `count_B` is the number of frames of each episode so far: as many as given, or more where `given_B` is T
    - 1 and older frames have left the window. `hidden`: the model is shown no action.
    """

    def one(frames: jax.Array, chunks: jax.Array, robot: jax.Array, given: jax.Array, count: jax.Array) -> Session:
        unseen = jnp.full((1, len(chunks)), hidden)
        session = start(model, frames[None], chunks[None], robot[None], action_hidden_BT=unseen)
        capacity = session.cache.capacity
        # Attention is causal: no frame that is kept has attended to the arbitrary ones after it.
        cache = session.cache._replace(valid=jnp.arange(capacity) < given - 1)
        # Past the window, frame j is in slot j mod (T - 1), where `steps.stream` puts it. Slots are the only axis of
        # `valid`, and the third one of all other arrays.
        cache = jax.tree.map(lambda x: jnp.roll(x, count - given, axis=0 if x.ndim == 1 else 2), cache)
        return session._replace(cache=cache, count=count)

    return jax.vmap(one)(frames, chunks_BTU, embodiment_B, given_B, count_B)


def advance_each(
    model: HMA,
    episodes: Episodes,
    chunk_BU: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    hidden: bool = False,
) -> tuple[Episodes, jax.Array]:
    """(episodes, frames [B, S (, C)]): `session.advance` for every episode, whether its window is full or not.

    Frame t of an episode is drawn from fold_in(key, t), where t counts the frames of that episode. `hidden`: the model
    is shown no action.
    """

    def each(phase: Phase) -> tuple[Episodes, jax.Array]:
        def one(session: Session, chunk: jax.Array, key: jax.Array) -> tuple[Session, jax.Array]:
            unseen = jnp.full(1, hidden)
            session, frame = advance(
                model, session, chunk[None], key[None], decode, action_hidden_B=unseen, phase=phase
            )
            return session, frame[0]

        return jax.vmap(one)(episodes, chunk_BU, key_B)

    def unless_none(which_B: jax.Array, phase: Phase) -> tuple[Episodes, jax.Array]:
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(lambda: each(phase)[1]))
        return jax.lax.cond(which_B.any(), lambda: each(phase), lambda: (episodes, nothing))

    filling_B = episodes.count <= model.config.frames - 1
    filled, slid = unless_none(filling_B, "filling"), unless_none(~filling_B, "sliding")
    new, frames = choose(filling_B, filled, slid)
    if decode.slide == "exact":
        # Past the window no pass reads an episode's cache, so all episodes take the caches that filling leaves, and
        # none is copied.
        new = new._replace(cache=filled[0].cache)
    return new, frames


def choose(which_B: jax.Array, new: T, old: T) -> T:
    """`new` where `which_B`, else `old`; both are trees of arrays with a leading axis B."""
    return jax.tree.map(lambda a, b: jnp.where(which_B.reshape(-1, *(1,) * (a.ndim - 1)), a, b), new, old)


def take(episodes: Episodes, rows_B: jax.Array) -> Episodes:
    """Episode b continues as a copy of episode `rows_B[b]`."""
    return jax.tree.map(lambda x: jnp.take(x, rows_B, axis=0), episodes)


def put(episodes: Episodes, rows_n: jax.Array, new: Episodes) -> Episodes:
    """Episode `rows_n[i]` continues as the i-th of `new`; the others are unchanged. A row may occur twice if its new
    episodes are equal."""
    return jax.tree.map(lambda whole, part: whole.at[rows_n].set(part), episodes, new)
