"""Teacher forcing: every frame of a window predicted from its true past, all in one pass.

The model is given frames 0 .. T-2 unmasked, followed by frames 1 .. T-1 masked: 2 (T - 1) frames under a mask that lets
each masked frame attend to the true frames before it, and no frame to a masked one. The official evaluation makes T - 1
passes over the window instead (reference section 6.2).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config.training import ActionLeak
from hma_jax.model.hma import HMA, Outputs, causal_mask


def teacher_forced_pass(
    model: HMA,
    past_frames: jax.Array,
    frames: jax.Array,
    masked: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    action_hidden_BT: jax.Array | None = None,
    *,
    leak: ActionLeak = "none",
    cache_frames: int = 0,
    robot_row_B: jax.Array | None = None,
) -> Outputs:
    """Predictions for `frames` [B, T - 1, S (, C)] at positions 1 .. T-1, masked where `masked` (bool) is True. Frame t
    attends to the first t of `past_frames`, which has the same shape and stands at positions 0 .. T-2.

    `actions_BTU` are the recorded chunks; `action_hidden_BT` and `leak` as for the model. The first `cache_frames` of
    `past_frames` are cached.
    """
    count = frames.shape[1]
    hidden = model.align_hidden(action_hidden_BT, actions_BTU.shape[:2])
    return model(
        jnp.concatenate([past_frames, frames], axis=1),
        jnp.concatenate([jnp.zeros_like(masked), masked], axis=1),
        _for_both_halves(model.align(actions_BTU)),
        embodiment_B,
        action_hidden_BT=None if hidden is None else _for_both_halves(hidden),
        leak=leak,
        visible=teacher_forcing_mask(causal_mask(count)),
        positions=jnp.concatenate([jnp.arange(count), jnp.arange(1, count + 1)]),
        cache_frames=cache_frames,
        before=jnp.concatenate([past_frames, past_frames], axis=1),
        predict_from=count,
        robot_row_B=robot_row_B,
    )


def teacher_forcing_mask(past: jax.Array) -> jax.Array:
    """bool [2 T, 2 T]: the frames that each of T true frames, and then each of T masked ones, attends to. A masked
    frame sees itself and the true frames that `past` [T, T] allows; no other frame sees it."""
    count = len(past)
    return jnp.block([[causal_mask(count), jnp.zeros_like(past)], [past, jnp.eye(count, dtype=bool)]])


def _for_both_halves(x: jax.Array) -> jax.Array:
    """[B, T, ...] -> [B, 2 (T - 1), ...]: frames 0 .. T-2, then 1 .. T-1."""
    return jnp.concatenate([x[:, :-1], x[:, 1:]], axis=1)
