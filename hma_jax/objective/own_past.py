"""Scheduled sampling: the model is trained on a past that it sampled itself, because in generation frames follow
generated frames.

Some past frames of a teacher-forced window are replaced by samples of the model's predictions for them; the true
frames that follow are still the targets, so that the model learns to correct its errors. The first round samples all of
them at once, each after its true past: they have the errors of a single frame. Each further round samples them again,
after the frames of the previous round, and so accumulates the errors of one more frame, as a rollout does. A round is
one pass without gradient.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config.training import ActionLeak
from hma_jax.kernels.random import fold_in_each
from hma_jax.model.frames import compose
from hma_jax.model.hma import HMA
from hma_jax.model.readout import choose_sampled
from hma_jax.model.teacher_forcing import teacher_forced_pass


def draw_own_past(
    model: HMA,
    before: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    action_hidden_BT: jax.Array | None,
    *,
    share: float,
    rounds: int,
    key_B: jax.Array,
    robot_row_B: jax.Array,
    leak: ActionLeak = "none",
) -> jax.Array:
    """Ids `before` [B, T - 1, S], in which each frame from the second on is replaced with probability `share` u (u
    uniform in [0, 1), drawn per example) by ids sampled from the model at temperature 1, in `rounds` rounds.

    The other arguments are as in `objective.losses.masked_loss`.
    """
    masked, head = jnp.ones(before.shape, bool), model.frame_head

    def choose_frames(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(a key for the ids, bool [T - 2]: the frames from the second on that are the model's)."""
        ids_key, share_key, frame_key = jax.random.split(key, 3)
        rate = share * jax.random.uniform(share_key, (), jnp.float32)
        return ids_key, jax.random.uniform(frame_key, (before.shape[1] - 1,), jnp.float32) < rate

    def draw(key: jax.Array, token_outputs_TS: jax.Array) -> jax.Array:
        digits, _ = head.decode_factors(token_outputs_TS, choose_sampled(key, head.shape(token_outputs_TS)))
        return compose(digits, model.config.factor_vocab).astype(before.dtype)

    ids_key_B, own_BT = jax.vmap(choose_frames)(key_B)
    past = before
    for number in range(rounds):
        out = teacher_forced_pass(
            model,
            past,
            past,
            masked,
            actions_BTU,
            embodiment_B,
            action_hidden_BT,
            leak=leak,
            robot_row_B=robot_row_B,
        )
        # Nothing follows the last frame.
        token_outputs = jax.lax.stop_gradient(out.token_outputs[:, :-1])
        # The first round uses the same keys however many rounds there are.
        keys = fold_in_each(ids_key_B, number) if number else ids_key_B
        own = jnp.where(own_BT[..., None], jax.vmap(draw)(keys, token_outputs), before[:, 1:])
        past = jnp.concatenate([before[:, :1], own], axis=1)
    return past
