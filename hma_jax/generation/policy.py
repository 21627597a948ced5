"""Actions predicted from frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, require
from hma_jax.kernels.random import Tag
from hma_jax.model.given import Array, checked_window
from hma_jax.model.hma import HMA, Outputs
from hma_jax.model.teacher_forcing import teacher_forcing_mask
from hma_jax.objective.diffusion import sample
from hma_jax.objective.losses import bidirectional_mask
from hma_jax.objective.process import make_process, sampling_process


def predict_actions(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    action_hidden_BT: Array,
    key_B: jax.Array,
    decode: DecodeConfig,
    *,
    causally: bool = True,
    real_BT: jax.Array | None = None,
) -> jax.Array:
    """Raw chunks [B, T, U] predicted at every frame; chunks that `action_hidden_BT` marks are not shown to the model.

    With `causally` True, as a policy, a frame's chunk is predicted from the frames up to it and the actions that are
    shown. With False (inverse dynamics) it is predicted from the whole window, without frames where `real_BT` is False
    (None: all are real). Padding is 0. Raises ConfigError as `next_frame_outputs`, and for a model without an action
    head.
    """
    frames = checked_window(model, frames, actions_BTU, embodiment_B, action_hidden_BT, shortest=1, subject="actions")
    count = frames.shape[1]
    visible = None if causally else bidirectional_mask(count, real_BT)
    hidden = model.align_hidden(action_hidden_BT, frames.shape[:2])
    out = model(frames, None, model.align(actions_BTU), embodiment_B, action_hidden_BT=hidden, visible=visible)
    return read_actions(model, out, embodiment_B, key_B, decode)


def predict_next_actions(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    key_B: jax.Array,
    decode: DecodeConfig,
) -> jax.Array:
    """Raw chunks [B, T, U]: the policy's action at every frame of a recorded window, given the frames up to it and all
    earlier actions.

    One pass. With causal alignment no frame is shown its own chunk; otherwise the window is followed by a copy of
    itself whose actions are hidden, under the mask of teacher forcing. Raises ConfigError as `predict_actions`.
    """
    frames = checked_window(model, frames, actions_BTU, embodiment_B, None, shortest=1, subject="actions")
    batch, count = frames.shape[:2]
    if model.config.action_alignment == "causal":
        nothing = jnp.zeros((batch, count), bool)
        return predict_actions(model, frames, actions_BTU, embodiment_B, nothing, key_B, decode)
    hidden = jnp.broadcast_to(jnp.arange(2 * count) >= count, (batch, 2 * count))
    before = jnp.tril(jnp.ones((count, count), bool), -1)
    out = model(
        jnp.concatenate([frames, frames], axis=1),
        None,
        jnp.concatenate([actions_BTU, actions_BTU], axis=1),
        embodiment_B,
        action_hidden_BT=hidden,
        visible=teacher_forcing_mask(before),
        positions=jnp.tile(jnp.arange(count), 2),
        predict_from=2 * count,
    )
    features_BTD = out.action_features_BTD
    own = out._replace(action_features_BTD=None if features_BTD is None else features_BTD[:, count:])
    return read_actions(model, own, embodiment_B, key_B, decode)


def read_actions(
    model: HMA, out: Outputs, embodiment_B: jax.Array, key_B: jax.Array, decode: DecodeConfig
) -> jax.Array:
    """Raw chunks [B, T, U] from a pass's action features (`Outputs.action_features_BTD`). Raises ConfigError without an
    action head."""
    require(
        model.action_head is not None and out.action_features_BTD is not None,
        "the model predicts no actions; train one with model.action_heads=true and a model.conditioning that "
        "contains concat",
    )
    if model.config.diffusion:
        normalised = _sample_actions(model, out.action_features_BTD, embodiment_B, key_B, decode)
    else:
        normalised = model.action_head(out.action_features_BTD, embodiment_B)
    return model.unnormalise(normalised, embodiment_B)


def _sample_actions(
    model: HMA, features_BTD: jax.Array, embodiment_B: jax.Array, key_B: jax.Array, decode: DecodeConfig
) -> jax.Array:
    """Normalised chunks [B, T, U]. Each value has its own random numbers, so that those of a robot do not depend on U,
    which other robots may determine."""
    config, width = model.config.diffusion, model.table.action_width
    process = sampling_process(make_process(config.steps), decode.sampler)
    shape = (*features_BTD.shape[:2], width)
    value = Tag.PER_FRAME * jnp.arange(shape[1])[:, None] + jnp.arange(width)
    keys = jax.vmap(lambda key: jax.vmap(jax.vmap(lambda n: jax.random.fold_in(key, n)))(value))(key_B)
    # In training, padding and dead dimensions are 0 even in noised chunks.
    alive_BTU = jnp.asarray(model.table.alive())[embodiment_B][:, None]

    def network(x: jax.Array, t: jax.Array) -> jax.Array:
        return model.action_head(jnp.where(alive_BTU, x, 0), t, features_BTD, embodiment_B)

    return sample(network, keys, shape, process, decode.sampler, config.clip)
