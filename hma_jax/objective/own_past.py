"""A past that the model made itself, for training: generated frames follow generated ones, which err.

Some past frames of a teacher-forced window are drawn from what the model says of them after their true past, and the
true frames that follow are still the targets: what errs is to be mended, not gone on with. One pass more, without
gradient; errors of a single frame, not those that a long rollout gathers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.model.beside import look_beside
from hma_jax.model.frames import compose
from hma_jax.model.hma import HMA
from hma_jax.model.readout import drawing


def draw_own_past(
    model: HMA,
    before: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    hidden_BT: jax.Array | None,
    greatest_share: float,
    key_B: jax.Array,
    slice_B: jax.Array,
) -> jax.Array:
    """Ids `before` [B, T - 1, S], frames from the second on replaced with probability `greatest_share` u, u uniform in
    [0, 1) of each example, by ids drawn from the model's own distribution at temperature 1.

    Needs the chunks that lead to them alone; for the meaning of the others see `objective.losses.masked_loss`.
    """
    masked = jnp.ones(before.shape, bool)
    said = look_beside(model, before, before, masked, actions_BTU, embodiment_B, hidden_BT, slice_B=slice_B).said
    said, head = jax.lax.stop_gradient(said[:, :-1]), model.frame_head  # of frames 1 .. T-2; nothing follows the last one

    def draw(key: jax.Array, said_TS: jax.Array, true_TS: jax.Array) -> jax.Array:
        ids_key, share_key, frame_key = jax.random.split(key, 3)
        digits, _ = head.factors_in_turn(said_TS, drawing(ids_key, head.shape(said_TS)))
        ids = compose(digits, model.config.factor_vocab)
        share = greatest_share * jax.random.uniform(share_key)
        own_T = jax.random.uniform(frame_key, (len(ids),)) < share
        return jnp.where(own_T[:, None], ids.astype(true_TS.dtype), true_TS)

    return jnp.concatenate([before[:, :1], jax.vmap(draw)(key_B, said, before[:, 1:])], axis=1)
