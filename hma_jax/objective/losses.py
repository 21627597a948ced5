"""The losses of masked tokens and hidden actions, for both variants.

The loss of discrete tokens is their cross-entropy, that of actions the squared error (paper section 3.3, equation 2).
In the continuous variant both have a diffusion loss (equation 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import MaskingConfig
from hma_jax.kernels.random import Tag, draw_flat, fold_in_each
from hma_jax.model.frames import factorise
from hma_jax.model.hma import HMA, Outputs
from hma_jax.model.teacher_forcing import teacher_forced_pass
from hma_jax.objective.diffusion import diffusion_loss
from hma_jax.objective.displaced import displace_patches
from hma_jax.objective.masking import Masked
from hma_jax.objective.own_past import draw_own_past
from hma_jax.objective.process import make_process

FIRST_PREDICTED = 1
"""The first frame that is predicted: frame 0 is never masked."""


class LossSums(NamedTuple):
    """Sums over a batch's targets; divide by their number in the whole batch."""

    tokens: jax.Array
    correct: jax.Array  # targets whose likeliest id is right, with the same weights; 0 in the continuous variant
    actions: jax.Array


class TargetCounts(NamedTuple):
    """How many targets a batch has, at least 1, so that a mean over none is 0. Tokens are weighted (`weigh_tokens`)."""

    tokens: jax.Array
    actions: jax.Array


def loss_metrics(sums: LossSums, counts: TargetCounts, masking: MaskingConfig, discrete: bool) -> dict[str, Any]:
    """Means over the targets by name: `loss` of everything, `accuracy` of `discrete` tokens, `action_loss`."""
    metrics = {"loss": sums.tokens / counts.tokens}
    if masking.predicts_frames and discrete:
        metrics["accuracy"] = sums.correct / counts.tokens
    if masking.predicts_actions:
        metrics["action_loss"] = sums.actions / counts.actions
        metrics["loss"] += masking.action_loss_weight * metrics["action_loss"]
    return metrics


def noise_keys(key: jax.Array, rows: int) -> jax.Array:
    """Keys [B] of the diffusion noise of a batch whose masks are drawn with `key`."""
    noise_key = jax.random.fold_in(key, Tag.NOISE)
    return jax.vmap(lambda row: jax.random.fold_in(noise_key, row))(jnp.arange(rows))


def weigh_tokens(masked: Masked, tokens: jax.Array, masking: MaskingConfig) -> jax.Array:
    """float32 [B, T, S]: the weight of each of the recorded `tokens` in the loss: 0 where it is no target, otherwise 1,
    or `masking.change_weight` where it differs from the token one frame earlier. Accuracy has the same weights."""
    weight = masked.targets_TS.astype(jnp.float32)
    if masking.change_weight == 1:
        return weight
    changed = tokens[:, 1:] != tokens[:, :-1]
    return weight.at[:, 1:].multiply(jnp.where(changed, masking.change_weight, 1.0))


def count_targets(masked: Masked, tokens: jax.Array, masking: MaskingConfig) -> TargetCounts:
    tokens_counted = jnp.sum(weigh_tokens(masked, tokens, masking))
    actions_counted = jnp.sum(masked.action_targets_T).astype(tokens_counted.dtype)
    return TargetCounts(*(jnp.maximum(n, 1) for n in (tokens_counted, actions_counted)))


def smoothed_cross_entropy(logits: jax.Array, labels: jax.Array, smoothing: float) -> tuple[jax.Array, jax.Array]:
    """Logits [..., Q, V], labels [..., Q] -> (the loss per position, summed over factors; bool, whether every
    factor's label has its highest logit), both [...].

    It uses logsumexp, so that no array of log-probabilities is made, and a mask that picks the label, so that the
    gradient needs no scatter.
    """
    total = jax.nn.logsumexp(logits, axis=-1)
    is_label = jnp.arange(logits.shape[-1]) == labels[..., None]
    picked = jnp.sum(jnp.where(is_label, logits, 0), axis=-1)
    loss = total - (1 - smoothing) * picked - smoothing * jnp.mean(logits, axis=-1)
    right = jax.lax.stop_gradient(picked) >= jax.lax.stop_gradient(jnp.max(logits, axis=-1))
    return jnp.sum(loss, axis=-1), jnp.all(right, axis=-1)


def masked_loss(
    model: HMA,
    masked: Masked,
    tokens: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    masking: MaskingConfig,
    key_B: jax.Array,
    robot_row_B: jax.Array | None = None,
    real_BT: jax.Array | None = None,
    *,
    training: bool,
) -> LossSums:
    """The loss sums of one batch under `masking.setting`. `key_B` draws diffusion noise, and the past that
    `masking.own_past` and `displaced_past` ask for; `robot_row_B` as for the model.

    `real_BT` (bool; None: all) is False for frames that only fill up a window, at its end. They have no targets
    (`masking`). With causal attention no real frame sees them; with other attention they are hidden here. `training` as
    for `frame_diffusion_loss`.
    """
    robot_row_B = embodiment_B if robot_row_B is None else robot_row_B
    out = _masked_pass(model, masked, actions_BTU, embodiment_B, masking, key_B, robot_row_B, real_BT)
    loss = correct = action_loss = jnp.zeros(())
    if masking.predicts_frames:
        weight, tokens = weigh_tokens(masked, tokens, masking)[:, FIRST_PREDICTED:], tokens[:, FIRST_PREDICTED:]
        if model.config.diffusion:
            per_token = frame_diffusion_loss(model, out.token_outputs, tokens, key_B, training=training)
        else:
            labels = factorise(tokens, model.config.factors, model.config.factor_vocab)
            logits = model.logits(out.token_outputs, tokens)
            per_token, right = smoothed_cross_entropy(logits, labels, masking.label_smoothing)
            correct = jnp.sum(right.astype(weight.dtype) * weight)
        loss = jnp.sum(per_token * weight)
    if masking.predicts_actions:
        per_step = action_loss_per_step(model, out.action_features_BTD, actions_BTU, embodiment_B, robot_row_B, key_B)
        action_loss = jnp.sum(per_step * masked.action_targets_T.astype(per_step.dtype))
    return LossSums(loss, correct, action_loss)


def _masked_pass(
    model: HMA,
    masked: Masked,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    masking: MaskingConfig,
    key_B: jax.Array,
    robot_row_B: jax.Array,
    real_BT: jax.Array | None,
) -> Outputs:
    """The model's outputs for the frames from FIRST_PREDICTED on; arguments are those of `masked_loss`."""
    all_shown = masking.shows_all_actions and all(model.table.chunks)
    hidden = None if all_shown else masked.action_hidden_T
    options = {"leak": masking.action_leak, "robot_row_B": robot_row_B}
    if not masking.teacher_forcing:
        return model(
            masked.inputs,
            masked.masked,
            model.align(actions_BTU),
            embodiment_B,
            action_hidden_BT=model.align_hidden(hidden, actions_BTU.shape[:2]),
            visible=bidirectional_mask(masked.inputs.shape[1], real_BT) if masking.setting == "inverse" else None,
            predict_from=FIRST_PREDICTED,
            **options,
        )
    past, given = masked.inputs[:, :-1], (actions_BTU, embodiment_B, hidden)
    if masking.own_past:
        share, rounds = masking.own_past, masking.own_past_rounds
        past = draw_own_past(model, past, *given, share=share, rounds=rounds, key_B=key_B, **options)
    if masking.displaced_past:
        past = displace_patches(past, masking.displaced_past, fold_in_each(key_B, Tag.DISPLACED_PAST))
    inputs, unknown = masked.inputs[:, FIRST_PREDICTED:], masked.masked[:, FIRST_PREDICTED:]
    return teacher_forced_pass(model, past, inputs, unknown, *given, **options)


def bidirectional_mask(frames: int, real_BT: jax.Array | None = None) -> jax.Array:
    """bool [T, T] or [B, T, T]: every frame attends to every real frame (`real_BT` None: all are real), also to later
    ones."""
    everything = jnp.ones((frames, frames), bool)
    return everything if real_BT is None else everything & real_BT[:, None]


def frame_diffusion_loss(
    model: HMA, z_BTSD: jax.Array, tokens_BTSC: jax.Array, key_B: jax.Array, *, training: bool
) -> jax.Array:
    """Per token [B, T, S]: squared error of the noise plus the bound's variance term (reference section 2.4).

    The distribution of steps, and the weight of the error at each, are configurable only for `training`
    (`DiffusionConfig.noise_shift`, `weight_cap`), so that all models with as many noising steps are judged in the same
    way.
    """
    config = model.config.diffusion
    process = make_process(config.steps)
    shifts = (config.noise_shift, config.time_shift) if training else (1.0, 1.0)
    cap = config.weight_cap if training else 0.0

    x0 = tokens_BTSC.astype(jnp.float32)

    def noised_copy(r: int) -> jax.Array:
        keys = fold_in_each(key_B, r)
        time, noise = jax.vmap(lambda key: draw_noise(key, x0.shape[1:], config.steps, *shifts))(keys)
        mse, vb = diffusion_loss(lambda x, t: model.denoiser(x, t, z_BTSD), x0, time, noise, process)
        if cap:
            mse *= jnp.asarray(process.noise_over_signal(cap), jnp.float32)[time]
        return mse + vb

    # The trunk's work is shared by all noised copies of a token.
    return jnp.stack([noised_copy(r) for r in range(config.repeats)]).mean(axis=0)


def draw_noise(
    key: jax.Array, shape: tuple[int, ...], steps: int, noise_shift: float = 1.0, time_shift: float = 1.0
) -> tuple[jax.Array, jax.Array]:
    """(time int [...], noise [..., C]) for values of `shape` [..., C]; the shifts as in `DiffusionConfig`."""
    time_key, noise_key = jax.random.split(key)

    def shifted(u: jax.Array, shift: float) -> jax.Array:
        return jnp.minimum(steps * shift * u / (1 + (shift - 1) * u), steps - 1).astype(jnp.int32)

    if noise_shift != 1:
        time = shifted(jax.random.uniform(time_key, shape[:-1]), noise_shift)
    else:
        time = jax.random.randint(time_key, shape[:-1], 0, steps, jnp.int32)
        if time_shift != 1:
            time = shifted((time + 0.5) / steps, time_shift)
    return time, draw_flat(jax.random.normal, noise_key, shape)


def action_loss_per_step(
    model: HMA,
    features_BTD: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    robot_row_B: jax.Array,
    key_B: jax.Array,
) -> jax.Array:
    """[B, T]: error of the predicted, normalised actions, averaged over the values that are alive
    (`EmbodimentTable.alive`).

    DIFFERS: the release compares with raw actions and averages over everything times the mean
    of the mask (reference section 1.8).
    """
    target = model.normalise(actions_BTU, embodiment_B)
    alive_BTU = jnp.broadcast_to(jnp.asarray(model.table.alive())[embodiment_B][:, None], target.shape)
    if model.config.diffusion:
        keys = fold_in_each(key_B, Tag.ACTION_NOISE)
        time, noise = jax.vmap(lambda k: draw_noise(k, target.shape[1:], model.config.diffusion.steps))(keys)

        def network(x: jax.Array, t: jax.Array) -> jax.Array:
            return model.action_head(x, t, features_BTD, robot_row_B)

        noise = jnp.where(alive_BTU, noise, 0)
        process = make_process(model.config.diffusion.steps)
        some_BTU = alive_BTU | ~alive_BTU.any(axis=-1, keepdims=True)  # a mean over nothing is no number
        return sum(diffusion_loss(network, target, time, noise, process, valid=some_BTU))
    error = jnp.square(model.action_head(features_BTD, robot_row_B) - target)
    alive_BTU = alive_BTU.astype(error.dtype)
    return jnp.sum(error * alive_BTU, axis=-1) / jnp.maximum(jnp.sum(alive_BTU, axis=-1), 1)
