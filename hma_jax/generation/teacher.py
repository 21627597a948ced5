"""Teacher-forced looks: every frame of a recorded window, wholly masked, after its true past."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.model.hma import HMA, causal


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
