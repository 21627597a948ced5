"""What a simulator compiles: from pixels and raw actions to pixels in one call each, of fixed shapes.

Begin from images, begin again from tokens, advance, copy: each takes and gives back the state of all episodes, and
all but the last use its memory again. The first three are compiled once for every power of two of episodes that they
are of (`padded`), so that the others cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import DecodeConfig
from hma_jax.generation.episodes import Episodes, advance_each, put, start_each, take
from hma_jax.kernels.random import key_of
from hma_jax.model.params import Params
from hma_jax.simulator.episode import Episode
from hma_jax.tokenizers.shared import BaseTokenizer
from hma_jax.training.runs import Model


class Beginning(NamedTuple):
    """Where n of the episodes begin, or begin again; padded to the room of T - 1 frames."""

    rows: np.ndarray  # int32 [n]: which; one that stands twice begins the same twice
    frames: np.ndarray  # uint8 [n, T - 1, H, W, 3], or tokens [n, T - 1, S (, C)]
    chunks: np.ndarray  # float32 [n, T - 2, U]
    robots: np.ndarray  # int32 [n]
    given: np.ndarray  # int32 [n]: how many of the frames are real
    counts: np.ndarray  # int32 [n]: frames so far

    @classmethod
    def blank(cls, rows: Sequence[int], room: int, width: int, shape: tuple[int, ...], dtype: Any) -> Beginning:
        """Of these episodes, with frames of `shape`, before they are placed."""
        n = len(rows)
        frames, chunks = np.zeros((n, room, *shape), dtype), np.zeros((n, room - 1, width), np.float32)
        return cls(np.array(rows, np.int32), frames, chunks, *np.zeros((3, n), np.int32))

    def place(self, i: int, episode: Episode, frames: np.ndarray) -> None:
        """The i-th of them begins as `episode` after the newest `frames` of its window."""
        given = len(frames)
        self.frames[i, :given] = frames
        if given > 1:
            self.chunks[i, : given - 1] = list(episode.chunks)[-(given - 1) :]
        self.robots[i], self.given[i], self.counts[i] = episode.index, given, episode.count


class Weights(NamedTuple):
    """What all programs compute with."""

    model: Params
    tokenizer: Params


def padded(rows: list[int], episodes: int) -> list[int]:
    """`rows` and the first of them again, up to a power of two or `episodes`."""
    size = min(1 << (len(rows) - 1).bit_length(), episodes)
    return rows + rows[:1] * (size - len(rows))


class Programs:
    """The compiled programs of a simulator of `episodes` episodes."""

    def __init__(self, model: Model, tokenizer: BaseTokenizer, episodes: int, decode: DecodeConfig):
        self.weights = Weights(model.params, tokenizer.params)
        declared, room = model.declared, model.config.frames - 1
        hidden = model.run.train.masking.ignores_actions
        decoded: Callable[[Weights, jax.Array], jax.Array] = lambda w, x: tokenizer.decode_uint8_fn(w.tokenizer, x)

        def fresh(weights: Weights, tokens: jax.Array, at: Beginning) -> Episodes:
            chunks, robots = jnp.asarray(at.chunks), jnp.asarray(at.robots)
            given, counts = jnp.asarray(at.given), jnp.asarray(at.counts)
            return start_each(declared.merge(weights.model), tokens, chunks, robots, given, counts, hidden=hidden)

        def again(weights: Weights, state: Episodes, at: Beginning) -> tuple[Episodes, jax.Array]:
            tokens = jnp.asarray(at.frames)
            newest = jnp.take_along_axis(tokens, at.given.reshape(-1, *(1,) * (tokens.ndim - 1)) - 1, axis=1)[:, 0]
            return put(state, at.rows, fresh(weights, tokens, at)), decoded(weights, newest)

        def begin(weights: Weights, state: Episodes, at: Beginning) -> tuple[Episodes, jax.Array, jax.Array]:
            images = jnp.asarray(at.frames)
            tokens = tokenizer.encode_fn(weights.tokenizer, images.reshape(-1, *images.shape[2:]))
            tokens = tokens.reshape(*images.shape[:2], *tokens.shape[1:])
            state, seen = again(weights, state, at._replace(frames=tokens))
            return state, tokens, seen

        def advance(
            weights: Weights, state: Episodes, rows_n: jax.Array, chunk_nU: jax.Array, seed_n: jax.Array
        ) -> tuple[Episodes, jax.Array, jax.Array]:
            keys = jax.vmap(key_of)(seed_n)
            before, hma = take(state, rows_n), declared.merge(weights.model)
            new, frames = advance_each(hma, before, chunk_nU, keys, decode, hidden=hidden)
            return put(state, rows_n, new), frames, decoded(weights, frames)

        self.begin = jax.jit(begin, donate_argnums=1)
        self.again = jax.jit(again, donate_argnums=1)
        self.advance = jax.jit(advance, donate_argnums=1)
        self.take = jax.jit(take)  # with its rows in order, a copy
        self.token_shape = (tokenizer.tokens, tokenizer.channels) if tokenizer.channels else (tokenizer.tokens,)
        described = jax.ShapeDtypeStruct
        empty = Beginning(
            described((episodes,), jnp.int32),
            described((episodes, room, *self.token_shape), jnp.float32 if tokenizer.channels else jnp.int32),
            described((episodes, room - 1, model.table.action_width), jnp.float32),
            *[described((episodes,), jnp.int32)] * 3,
        )
        self._shapes = jax.eval_shape(lambda weights, at: fresh(weights, at.frames, at), self.weights, empty)

    def empty(self) -> Episodes:
        """The state of episodes of which none has begun, where the weights lie: programs give it back there, and would
        be compiled a second time for a state from elsewhere."""
        place = jax.tree.leaves(self.weights)[0].sharding
        return jax.device_put(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._shapes), place)
