"""Teacher forcing: every frame of a window predicted from its true past, all in one pass.

Frames 0 .. T-2 as they are and, beside them, frames 1 .. T-1 with masks: 2 (T - 1) frames, where the official
evaluation makes T - 1 passes over the window (reference section 6.2).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config.training import ActionLeak
from hma_jax.model.hma import HMA, Outputs, causal


def look_beside(
    model: HMA,
    before: jax.Array,
    ahead: jax.Array,
    masked: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None = None,
    *,
    leak: ActionLeak = "none",
    cache_frames: int = 0,
    slice_B: jax.Array | None = None,
) -> Outputs:
    """What the model says of frames `ahead` [B, T - 1, S (, C)] at positions 1 .. T-1, of which it is not shown what
    bool `masked` says; each follows the frames of `before`, of that shape too, from position 0 on.

    Actions are the recorded chunks, of which those that `hidden_BT` says are not shown (`leak` as for the model);
    `cache_frames` frames of `before` are cached.
    """
    count = ahead.shape[1]
    hidden = model.align_hidden(hidden_BT, actions_BTU.shape[:2])
    return model(
        jnp.concatenate([before, ahead], axis=1),
        jnp.concatenate([jnp.zeros_like(masked), masked], axis=1),
        _twice(model.align(actions_BTU)),
        embodiment_B,
        hidden_BT=None if hidden is None else _twice(hidden),
        leak=leak,
        visible=beside(causal(count)),
        positions=jnp.concatenate([jnp.arange(count), jnp.arange(1, count + 1)]),
        cache_frames=cache_frames,
        before=jnp.concatenate([before, before], axis=1),
        predict_from=count,
        slice_B=slice_B,
    )


def beside(past: jax.Array) -> jax.Array:
    """bool [2 T, 2 T]: what frames and, beside them, T masked ones may see. A masked frame sees the true
    frames that `past` [T, T] allows it, and itself; nobody sees a masked frame."""
    count = len(past)
    return jnp.block([[causal(count), jnp.zeros_like(past)], [past, jnp.eye(count, dtype=bool)]])


def _twice(x: jax.Array) -> jax.Array:
    """[B, T, ...] -> [B, 2 (T - 1), ...]: frames 0 .. T-2, then 1 .. T-1."""
    return jnp.concatenate([x[:, :-1], x[:, 1:]], axis=1)
