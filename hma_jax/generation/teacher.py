"""Teacher forcing: every frame of a recorded window, masked, after its true past, all at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig
from hma_jax.generation.decoding import Frame, decode_frame
from hma_jax.model.hma import HMA, Outputs, causal


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
    out = _look_beside(model, frames, actions_BTU, embodiment_B, hidden_BT, keep=0)
    return out.frames[:, frames.shape[1] - 1 :]


def next_frames(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    hidden_BT: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """(outputs, filled): what `next_frame_outputs` says and frames 1 .. T-1 [B, T - 1, S (, C)], each
    predicted from its true past.

    Frame t is drawn from fold_in(key, t), as in `rollout`. M passes over T - 1 masked frames and
    one over the true ones, where the official evaluation makes M (T - 1) over the window.
    """
    count = frames.shape[1] - 1
    out = _look_beside(model, frames, actions_BTU, embodiment_B, hidden_BT, keep=count)
    first = out.frames[:, count:]
    actions = model.align(actions_BTU)[:, 1:]
    hidden = model.align_hidden(hidden_BT, frames.shape[:2])
    hidden = None if hidden is None else hidden[:, 1:]
    fold = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731  [B, T - 1, ...] -> [B (T - 1), ...]
    unfold = lambda x: x.reshape(-1, count, *x.shape[1:])  # noqa: E731

    def look(frame: Frame) -> jax.Array:
        said = model(
            unfold(frame.values),
            unfold(frame.masked),
            actions,
            embodiment_B,
            hidden_BT=hidden,
            visible=jnp.concatenate([causal(count), jnp.eye(count, dtype=bool)], axis=1),
            first=1,
            past=out.cache,
        )
        return fold(said.frames)

    keys = jax.vmap(lambda k: jax.vmap(lambda t: jax.random.fold_in(k, t))(jnp.arange(1, count + 1)))(key_B)
    return first, unfold(decode_frame(model, fold(first), look, fold(keys), decode))


def _look_beside(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None,
    keep: int,
) -> Outputs:
    """One pass over frames 0 .. T-2 and, beside them, 1 .. T-1 wholly masked."""
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
    return model(
        both,
        masked,
        actions,
        embodiment_B,
        hidden_BT=hidden,
        visible=visible,
        positions=positions,
        keep=keep,
    )
