"""The programs that a simulator compiles: each maps pixels and raw actions to pixels in one call, with fixed shapes.

`reset_from_images`, `reset_from_tokens`, `advance` and `take` each map the state of all episodes to a new one; all
except the last donate it. The first three work on some of the episodes, so that the others cost nothing, and are
compiled for each power of two of their number (`padded`). Advancing all episodes is a separate program, which copies no
state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import DecodeConfig
from hma_jax.generation.episodes import Episodes, advance_each, put, start_each, take
from hma_jax.kernels.random import key_of
from hma_jax.model.params import Params
from hma_jax.simulator.episode import Episode
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.training.runs import Model


class ResetInputs(NamedTuple):
    """Frames and chunks from which n of the episodes start, or to which they are rewound, padded to T - 1 frames."""

    rows: np.ndarray  # int32 [n]: the episodes; one may be repeated, with equal values
    frames: np.ndarray  # uint8 [n, T - 1, H, W, 3], or tokens [n, T - 1, S (, C)]
    chunks: np.ndarray  # float32 [n, T - 2, U]
    robots: np.ndarray  # int32 [n]
    given: np.ndarray  # int32 [n]: how many of the frames are real
    counts: np.ndarray  # int32 [n]: frames so far

    @classmethod
    def empty(cls, rows: Sequence[int], capacity: int, width: int, shape: tuple[int, ...], dtype: Any) -> ResetInputs:
        """Inputs for the episodes `rows`, with frames of `shape`; all zeros until `set_episode`."""
        n = len(rows)
        frames, chunks = np.zeros((n, capacity, *shape), dtype), np.zeros((n, capacity - 1, width), np.float32)
        return cls(np.array(rows, np.int32), frames, chunks, *np.zeros((3, n), np.int32))

    def set_episode(self, i: int, episode: Episode, frames: np.ndarray) -> None:
        """Sets the i-th row to `episode`, whose newest frames are `frames`, at most T - 1."""
        given = len(frames)
        self.frames[i, :given] = frames
        if given > 1:
            self.chunks[i, : given - 1] = list(episode.chunks)[-(given - 1) :]
        self.robots[i], self.given[i], self.counts[i] = episode.index, given, episode.count


class ProgramParams(NamedTuple):
    """Parameters that all programs take as an argument."""

    model: Params
    tokenizer: Params


def padded(rows: list[int], episodes: int) -> list[int]:
    """`rows`, padded with copies of the first to a power of two, at most `episodes`."""
    size = min(1 << (len(rows) - 1).bit_length(), episodes)
    return rows + rows[:1] * (size - len(rows))


class Programs:
    """The compiled programs of a simulator of `episodes` episodes."""

    def __init__(self, model: Model, tokenizer: Tokenizer, episodes: int, decode: DecodeConfig):
        self.weights = ProgramParams(model.params, tokenizer.params)
        declared, capacity = model.declared, model.config.frames - 1
        hidden = model.run.train.masking.ignores_actions

        def to_images(weights: ProgramParams, tokens: jax.Array) -> jax.Array:
            return tokenizer.decode_uint8_fn(weights.tokenizer, tokens)

        def fresh(weights: ProgramParams, at: ResetInputs) -> Episodes:
            hma = declared.merge(weights.model)
            return start_each(hma, at.frames, at.chunks, at.robots, at.given, at.counts, hidden=hidden)

        def reset_from_tokens(weights: ProgramParams, state: Episodes, at: ResetInputs) -> tuple[Episodes, jax.Array]:
            last = at.given.reshape(-1, *(1,) * (at.frames.ndim - 1)) - 1
            newest = jnp.take_along_axis(at.frames, last, axis=1)[:, 0]
            return put(state, at.rows, fresh(weights, at)), to_images(weights, newest)

        def reset_from_images(
            weights: ProgramParams, state: Episodes, at: ResetInputs
        ) -> tuple[Episodes, jax.Array, jax.Array]:
            tokens = tokenizer.encode_fn(weights.tokenizer, at.frames.reshape(-1, *at.frames.shape[2:]))
            tokens = tokens.reshape(*at.frames.shape[:2], *tokens.shape[1:])
            state, seen = reset_from_tokens(weights, state, at._replace(frames=tokens))
            return state, tokens, seen

        def advance(
            weights: ProgramParams, state: Episodes, rows_n: jax.Array | None, chunk_nU: jax.Array, seed_n: jax.Array
        ) -> tuple[Episodes, jax.Array, jax.Array]:
            """Advances the episodes `rows_n`; None: all, in order."""
            keys = jax.vmap(key_of)(seed_n)
            before, hma = state if rows_n is None else take(state, rows_n), declared.merge(weights.model)
            new, frames = advance_each(hma, before, chunk_nU, keys, decode, hidden=hidden)
            return new if rows_n is None else put(state, rows_n, new), frames, to_images(weights, frames)

        self.reset_from_images = jax.jit(reset_from_images, donate_argnums=1)
        self.reset_from_tokens = jax.jit(reset_from_tokens, donate_argnums=1)
        self.advance = jax.jit(advance, donate_argnums=1)
        self.take = jax.jit(take)  # with all rows in order, it is a copy
        frame = model.config.frame_shape, model.config.frame_dtype
        blank = ResetInputs.empty(range(episodes), capacity, model.table.action_width, *frame)
        self._shapes = jax.eval_shape(fresh, self.weights, blank)

    def empty(self) -> Episodes:
        """The state before any episode has begun, on the device of the weights. Programs return states there, and would
        be compiled again for a state on another device."""
        sharding = jax.tree.leaves(self.weights)[0].sharding
        return jax.device_put(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._shapes), sharding)
