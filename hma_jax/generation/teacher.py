"""Teacher forcing: every frame of a recorded window, masked, after its true past, all at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.decoding import Frame, decode_frame
from hma_jax.generation.rollout import fold_in
from hma_jax.model.hma import HMA, Outputs, causal_mask
from hma_jax.model.teacher_forcing import teacher_forced_pass


def next_frame_outputs(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None = None,
) -> jax.Array:
    """`Outputs.predictions` for frames 1 .. T-1, each wholly masked after its true past: [B, T - 1, S, Q, V] or
    [B, T - 1, S, D].
    """
    return _fully_masked_pass(model, frames, actions_BTU, embodiment_B, hidden_BT).predictions


def next_frames(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    hidden_BT: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """(predictions, frames): those of `next_frame_outputs`, and frames 1 .. T-1 [B, T - 1, S (, C)] decoded from them,
    each after its true past.

    Frame t is drawn from fold_in(key, t), as in `rollout`. M passes over T - 1 masked frames and
    one over the true ones, where the official evaluation makes M (T - 1) over the window.
    """
    count = frames.shape[1] - 1
    out = _fully_masked_pass(model, frames, actions_BTU, embodiment_B, hidden_BT, cache_frames=count)
    actions = model.align(actions_BTU)[:, 1:]
    hidden = model.align_hidden(hidden_BT, frames.shape[:2])
    hidden = None if hidden is None else hidden[:, 1:]

    def predict(frame: Frame) -> jax.Array:
        """For all masked frames at once, as if they were examples: [B (T - 1), S, ...]."""
        out_of_past = model(
            _by_window(frame.values, count),
            _by_window(frame.masked, count),
            actions,
            embodiment_B,
            hidden_BT=hidden,
            visible=jnp.concatenate([causal_mask(count), jnp.eye(count, dtype=bool)], axis=1),
            first=1,
            past=out.cache,
            before=frames[:, :-1],
        )
        return _by_frame(out_of_past.predictions)

    keys = jnp.stack([fold_in(key_B, t) for t in range(1, count + 1)], axis=1)
    filled = decode_frame(model, _by_frame(out.predictions), predict, _by_frame(keys), decode)
    return out.predictions, _by_window(filled, count)


def _fully_masked_pass(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None,
    cache_frames: int = 0,
) -> Outputs:
    """`teacher_forced_pass` with frames 1 .. T-1 wholly masked."""
    before = frames[:, :-1]  # what lies under a mask does not matter
    masked = jnp.ones(before.shape[:3], bool)
    return teacher_forced_pass(
        model, before, before, masked, actions_BTU, embodiment_B, hidden_BT, cache_frames=cache_frames
    )


def _by_frame(x: jax.Array) -> jax.Array:
    """[B, T - 1, ...] -> [B (T - 1), ...]."""
    return x.reshape(-1, *x.shape[2:])


def _by_window(x: jax.Array, count: int) -> jax.Array:
    """The inverse."""
    return x.reshape(-1, count, *x.shape[1:])
