"""Teacher forcing: every frame of a recorded window is predicted from its true past, all at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.decoding import Frame, decode_frame
from hma_jax.kernels.random import fold_in_each
from hma_jax.model.given import Array, checked_window, require_keys
from hma_jax.model.hma import HMA, Outputs, causal_mask
from hma_jax.model.teacher_forcing import teacher_forced_pass


def next_frame_outputs(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    action_hidden_BT: Array | None = None,
) -> jax.Array:
    """`Outputs.token_outputs` for frames 1 .. T-1, each wholly masked after its true past: [B, T - 1, S, Q, V] or
    [B, T - 1, S, D].

    Raises ConfigError for a window that is longer than the model's, for other shapes that do not fit the model or each
    other, and for unknown ids and robots as `rollout`.
    """
    frames = checked_window(
        model, frames, actions_BTU, embodiment_B, action_hidden_BT, shortest=2, subject="next frames"
    )
    return _fully_masked_pass(model, frames, actions_BTU, embodiment_B, action_hidden_BT).token_outputs


def next_frames(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    action_hidden_BT: Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """(predictions, frames): the predictions of `next_frame_outputs`, and frames 1 .. T-1 [B, T - 1, S (, C)] decoded
    from them, each after its true past.

    Frame t is drawn from fold_in(key, t), as in `rollout`. This takes M passes over T - 1 masked frames and one pass
    over the true ones; the official evaluation makes M (T - 1) passes over the window. Raises ConfigError as
    `next_frame_outputs`.
    """
    frames = checked_window(
        model, frames, actions_BTU, embodiment_B, action_hidden_BT, shortest=2, subject="next frames"
    )
    require_keys(key_B, len(frames))
    count = frames.shape[1] - 1
    out = _fully_masked_pass(model, frames, actions_BTU, embodiment_B, action_hidden_BT, cache_frames=count)
    actions = model.align(actions_BTU)[:, 1:]
    hidden = model.align_hidden(action_hidden_BT, frames.shape[:2])
    hidden = None if hidden is None else hidden[:, 1:]

    def predict(frame: Frame) -> jax.Array:
        """For all masked frames at once, as if they were examples: [B (T - 1), S, ...]."""
        out_of_past = model(
            _by_window(frame.values, count),
            _by_window(frame.masked, count),
            actions,
            embodiment_B,
            action_hidden_BT=hidden,
            visible=jnp.concatenate([causal_mask(count), jnp.eye(count, dtype=bool)], axis=1),
            positions=jnp.arange(1, count + 1),
            past=out.cache,
            before=frames[:, :-1],
        )
        return _by_frame(out_of_past.token_outputs)

    keys = jnp.stack([fold_in_each(key_B, t) for t in range(1, count + 1)], axis=1)
    filled = decode_frame(model, _by_frame(out.token_outputs), predict, _by_frame(keys), decode)
    return out.token_outputs, _by_window(filled, count)


def _fully_masked_pass(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    action_hidden_BT: Array | None,
    cache_frames: int = 0,
) -> Outputs:
    """`teacher_forced_pass` with frames 1 .. T-1 wholly masked."""
    before = frames[:, :-1]  # what lies under a mask does not matter
    masked = jnp.ones(before.shape[:3], bool)
    return teacher_forced_pass(
        model, before, before, masked, actions_BTU, embodiment_B, action_hidden_BT, cache_frames=cache_frames
    )


def _by_frame(x: jax.Array) -> jax.Array:
    """[B, T - 1, ...] -> [B (T - 1), ...]."""
    return x.reshape(-1, *x.shape[2:])


def _by_window(x: jax.Array, count: int) -> jax.Array:
    """The inverse of `_by_frame`."""
    return x.reshape(-1, count, *x.shape[1:])
