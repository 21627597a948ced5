"""The evaluation protocol: what a model is asked to predict in a window.

Paper section 4 (Metrics), reference section 6. For every window of a frozen manifest:

* likelihood: cross-entropy (continuous: diffusion loss) of each frame, wholly masked, given the
  true frames before it;
* fidelity: PSNR and SSIM, means over the predicted frames, of an autoregressive rollout from the
  prompt against the recorded images (not their reconstruction by the tokenizer); for windows longer than the model's,
  rollouts continue past it, and the likelihood is that of the first T frames;
* controllability: delta PSNR = PSNR of the last frame under the true actions minus its mean
  under random action sequences, with the same random numbers for unmasking;
* more on controllability, where a batch has other episodes' actions: action-nats, retrieval and counterfactual PSNR
  (`controllability`);
* policy, where the model was trained to predict actions: squared error of every chunk after the
  prompt, given the true frames and actions before it (inverse dynamics: of every chunk that leads to
  a frame of the window, given all frames and no action), against that of the mean action.

A model trained on passive video is shown no actions at all. A model trained only for actions is not asked for frames.

With `eval.context` "recorded" every frame is predicted from recorded frames, and random actions replace all actions of
a window, as in the release; this is for comparison with published figures. DIFFERS: `psnr` is the mean over all
predicted frames, as SSIM is; the release's PSNR is that of the last frame, `psnr_last` here. Random and true actions
share their random numbers (reference section 6.3). The release's own autoregressive mode replaces only one context
frame (reference section 6.2); ours is a rollout.

Everything here is pure and works on tokens; their comparison as images is in `images`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import EvalConfig, ExecutionConfig, MaskingSetting, ModelConfig, require
from hma_jax.config.training import PREDICT_ACTIONS, PREDICT_FRAMES
from hma_jax.evaluation.controllability import action_metrics, for_each_sequence
from hma_jax.evaluation.draws import Purpose, random_actions, table_statistics, window_keys
from hma_jax.evaluation.likelihood import window_loss
from hma_jax.evaluation.metrics import last_frames, mean_over_frames
from hma_jax.generation import next_frame_outputs, next_frames, predict_actions, predict_next_actions, rollout
from hma_jax.model.embodiments import ActionUnits, EmbodimentTable, normalise
from hma_jax.model.frames import compose
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Params
from hma_jax.model.readout import choose_likeliest
from hma_jax.objective.masking import followed, hidden_at_inference

Batch = dict[str, jax.Array]
"""Arrays by name:

    tokens          int32 [B, T, S], or latents [B, T, S, C]
    actions         float32 [B, T, U], raw, zero-padded
    embodiment      int32 [B]
    episode, start  int32 [B]; with the robot's name they identify a window

Optional:

    real            bool [B, T]: False for padding frames at the end of a short window, which are ignored
    action_mean     float32 [B, U]: of all recorded actions, for random ones and errors; default: the table's
    action_std      float32 [B, U]: likewise
    other_actions   float32 [B, O, T, U]: of other episodes of the same robot
    other_valid     bool [B, O]: which of them exist
    other_images    uint8 [B, T, H, W, 3]: true frames under the first of them, from the prompt on
    other_seen      bool [B]: whether these are known
"""


class Recorded(NamedTuple):
    """Frames and chunks that fit the model's window."""

    tokens: jax.Array  # [B, T, S (, C)]
    actions_BTU: jax.Array
    embodiment_B: jax.Array


class Predicted(NamedTuple):
    """Tokens of the frames that are compared, from `EvalConfig.first_predicted` on."""

    tokens: jax.Array  # under the recorded actions [B, n, S (, C)]
    random_last: jax.Array  # of the last (real) frame, under each random sequence [B, draws, S (, C)]
    random: jax.Array | None  # under the first random sequence [B, n, S (, C)]; None where only the last frame was made
    other: jax.Array | None = None  # under the first sequence of another episode; None without other_images


def predicts_actions(model: ModelConfig, setting: MaskingSetting) -> bool:
    """Whether a model trained for `setting` has a policy to evaluate. Without action tokens there is none, though
    imported models may say so: the release then reads actions from image tokens (reference section 1.7)."""
    return model.action_heads and model.concat and setting in PREDICT_ACTIONS


def predicts_frames(setting: MaskingSetting) -> bool:
    """Whether a model trained for `setting` has frames to evaluate."""
    return setting in PREDICT_FRAMES


def evaluation_inputs(batch: Batch, table: EmbodimentTable, config: EvalConfig) -> tuple[jax.Array, jax.Array]:
    """(chunks [B, 1 + draws, T, U], keys of decoding [B]). The chunks are the recorded actions, then the random ones,
    which differ from the recorded ones from the first chunk that leads to a predicted frame on."""
    actions, frames, first_free = batch["actions"], batch["actions"].shape[1], config.first_predicted - 1
    key_B = keys_of(batch, "actions", table, config)
    other = random_actions(key_B, action_statistics(batch, table), config.random_actions, frames)
    other = other.at[:, :, :first_free].set(actions[:, None, :first_free])
    decoding_B = keys_of(batch, "decoding", table, config)
    return jnp.concatenate([actions[:, None], other], axis=1), decoding_B


def keys_of(batch: Batch, purpose: Purpose, table: EmbodimentTable, config: EvalConfig) -> jax.Array:
    """A key for each window of a batch, [B]."""
    return window_keys(config.seed, purpose, table, batch["embodiment"], batch["episode"], batch["start"])


def action_statistics(batch: Batch, table: EmbodimentTable) -> tuple[jax.Array, jax.Array]:
    """(mean, std) of each window's actions, [B, U] each: those in the batch, which are the same for every model, or
    otherwise the table's."""
    if "action_mean" in batch:
        return batch["action_mean"], batch["action_std"]
    return table_statistics(batch["embodiment"], table)


def make_predictor(
    model: ModelConfig,
    table: EmbodimentTable,
    config: EvalConfig,
    setting: MaskingSetting = "forward",
    execution: ExecutionConfig = ExecutionConfig(),
) -> Callable[..., tuple[dict[str, jax.Array], Predicted | None]]:
    """f(params, batch, units) -> (metrics of tokens and actions {name: [B]}, Predicted), to be jitted. For a model
    trained only for actions, Predicted is None. `units`, by default the table's, are the ActionUnits with which the
    model was trained.

    `finite`, bool [B], says whether likelihoods and, where there are actions to predict, their errors are finite. Ids
    cannot show this: they are integers even where they were chosen by logits that are not finite.

    Raises ConfigError for a prompt that leaves nothing to judge.
    """
    require(
        config.first_predicted < model.frames or not predicts_frames(setting),
        f"eval.prompt_frames {config.prompt_frames} leaves no frame to predict in a window of {model.frames} frames; "
        "use fewer",
    )
    require(
        config.prompt_frames <= model.frames - (setting == "inverse") or not predicts_actions(model, setting),
        f"eval.prompt_frames {config.prompt_frames} leaves no action to evaluate in a window of {model.frames} "
        "frames; use fewer",
    )
    declared = declare_model(model, table, execution)

    def predict(
        params: Params, batch: Batch, units: ActionUnits = table.scale()
    ) -> tuple[dict[str, jax.Array], Predicted | None]:
        hma, real = declared.merge(params).with_action_units(units), batch.get("real")
        window = Recorded(batch["tokens"][:, : model.frames], batch["actions"][:, : model.frames], batch["embodiment"])
        real_window = None if real is None else real[:, : model.frames]

        metrics, predicted = {"finite": jnp.ones(len(window.tokens), bool)}, None
        if predicts_frames(setting):
            metrics, predicted = _frame_metrics(hma, window, batch, table, config, setting)
        if predicts_actions(model, setting):
            errors = _policy_errors(
                hma,
                window,
                keys_of(batch, "policy", table, config),
                config,
                causally=setting != "inverse",
                statistics=action_statistics(batch, table),
                real_BT=real_window,
            )
            metrics |= errors | {"finite": metrics["finite"] & errors["finite"]}
        return metrics, predicted

    return predict


def _frame_metrics(
    hma: HMA,
    window: Recorded,
    batch: Batch,
    table: EmbodimentTable,
    config: EvalConfig,
    setting: MaskingSetting,
) -> tuple[dict[str, jax.Array], Predicted]:
    """(metrics of tokens, Predicted) of a model that was trained for frames; `window` is the part of the batch that
    fits the model's window."""
    model, key_B = hma.config, keys_of(batch, "likelihood", table, config)
    tokens, actions, robots = batch["tokens"], batch["actions"], batch["embodiment"]
    hidden = hidden_at_inference(table, setting, robots, actions.shape[1])
    sequences, decoding = evaluation_inputs(batch, table, config)
    real = batch.get("real")
    hidden_window = None if hidden is None else hidden[:, : model.frames]
    real_from_1 = None if real is None else real[:, 1 : model.frames]

    def likelihood(out: jax.Array) -> dict[str, jax.Array]:
        return _likelihood(hma, out, window.tokens[:, 1:], key_B, real_from_1)

    def likelihood_under(actions_BTU: jax.Array) -> dict[str, jax.Array]:
        return likelihood(next_frame_outputs(hma, window.tokens, actions_BTU, robots, hidden_window))

    if config.context == "recorded":
        require(
            tokens.shape[1] == model.frames,
            f"with eval.context 'recorded' windows must have the model's {model.frames} frames, got {tokens.shape[1]}",
        )
        out, predicted = _after_recorded(hma, window, sequences, decoding, config, hidden, real)
    else:
        if counterfactual := "other_images" in batch:
            other = batch["other_actions"][:, :1]
            before = jnp.arange(tokens.shape[1])[:, None] < config.first_predicted - 1
            sequences = jnp.concatenate([sequences, jnp.where(before, actions[:, None], other)], axis=1)
        prompt = tokens[:, : config.prompt_frames]
        made = rollout(hma, prompt, sequences, robots, decoding, config.decode, action_hidden_BT=hidden)
        ahead = None if real is None else real[:, config.prompt_frames :]
        random = made[:, 1 : 1 + config.random_actions]
        last = last_frames(random, ahead, axis=2)
        predicted = Predicted(made[:, 0], last, random[:, 0], made[:, -1] if counterfactual else None)
    if "other_actions" in batch:
        found = for_each_sequence(likelihood_under, window.actions_BTU, batch["other_actions"][:, :, : model.frames])
        loss, finite = found["diffusion_loss" if model.diffusion else "cross_entropy"], found["finite"]
        metrics = {name: x[0] for name, x in found.items()} | action_metrics(loss, batch["other_valid"])
        metrics["finite"] &= (finite[1:] | ~batch["other_valid"].T).all(0)
        return metrics, predicted
    return likelihood_under(window.actions_BTU) if config.context == "generated" else likelihood(out), predicted


def _after_recorded(
    model: HMA,
    window: Recorded,
    sequences: jax.Array,
    key_B: jax.Array,
    config: EvalConfig,
    action_hidden_BT: jax.Array | None,
    real_BT: jax.Array | None,
) -> tuple[jax.Array, Predicted]:
    """(outputs, Predicted) where every frame is predicted from recorded frames."""
    tokens, actions, embodiment = window
    out, predicted = next_frames(model, tokens, actions, embodiment, key_B, config.decode, action_hidden_BT)
    draws = sequences.shape[1] - 1

    def each(x: jax.Array) -> jax.Array:
        """[B, ...] -> [B draws, ...]"""
        return jnp.repeat(x, draws, axis=0)

    # The sequences differ from the first chunk on, so they can share nothing of the past.
    if real_BT is not None:  # windows end at different frames: all are made, and the last of each window is taken
        others = sequences[:, 1:].reshape(-1, *actions.shape[1:])
        hidden = None if action_hidden_BT is None else each(action_hidden_BT)
        _, made = next_frames(model, each(tokens), others, each(embodiment), each(key_B), config.decode, hidden)
        last = last_frames(made, each(real_BT[:, 1:]))
        return out, Predicted(predicted, last.reshape(len(tokens), draws, *tokens.shape[2:]), None)
    last = rollout(
        model,
        each(tokens[:, :-1]),
        sequences[:, 1:].reshape(-1, 1, *actions.shape[1:]),
        each(embodiment),
        each(key_B),
        config.decode,
        action_hidden_BT=None if action_hidden_BT is None else each(action_hidden_BT),
    )
    return out, Predicted(predicted, last.reshape(len(tokens), draws, *tokens.shape[2:]), None)


def _likelihood(
    model: HMA, out: jax.Array, truth: jax.Array, key_B: jax.Array, real_BT: jax.Array | None
) -> dict[str, jax.Array]:
    """Per window [B]: how well the predictions `out` fit the true tokens, and whether the loss is `finite`. DIFFERS:
    accuracy is that of the likeliest ids of the wholly masked frame; in the release it is that of the ids after all
    unmasking steps (reference section 6.3)."""
    loss = window_loss(model, out, truth, key_B, real_BT)
    if model.config.diffusion:
        return {"diffusion_loss": loss, "finite": jnp.isfinite(loss)}
    guess = compose(model.frame_head.decode_factors(out, choose_likeliest)[0], model.config.factor_vocab)
    accuracy = mean_over_frames((guess == truth).astype(jnp.float32), real_BT)
    return {"cross_entropy": loss, "accuracy": accuracy, "finite": jnp.isfinite(loss)}


def _policy_errors(
    model: HMA,
    window: Recorded,
    key_B: jax.Array,
    config: EvalConfig,
    *,
    causally: bool,
    statistics: tuple[jax.Array, jax.Array],
    real_BT: jax.Array | None,
) -> dict[str, jax.Array]:
    """Per window [B]: mean squared error of the chunks after the prompt, in variances of each action value that is
    alive, for the model and for always giving the mean action. It is nan where no value is alive, as for a robot
    without actions, and where the window ends before the prompt does. `finite` says whether the error is finite
    wherever it is defined."""
    tokens, actions_BTU, embodiment_B = window
    decode, first, judged_BT = config.decode, config.prompt_frames - 1, real_BT
    if causally:
        predicted = predict_next_actions(model, tokens, actions_BTU, embodiment_B, key_B, decode)
    else:
        everything = jnp.ones(tokens.shape[:2], bool)
        predicted = predict_actions(
            model, tokens, actions_BTU, embodiment_B, everything, key_B, decode, causally=False, real_BT=real_BT
        )
        judged_BT = followed(everything if real_BT is None else real_BT)
    mean_BU, std_BU = statistics
    alive_BU = std_BU > 0
    truth, guess = (normalise(x, mean_BU[:, None], std_BU[:, None])[:, first:] for x in (actions_BTU, predicted))

    def mean(error_BTU: jax.Array) -> jax.Array:
        of_window = error_BTU.mean(1)
        if judged_BT is not None:
            judged = judged_BT[:, first:, None]
            of_window = jnp.sum(error_BTU * judged, 1) / jnp.sum(judged, 1)
        return jnp.sum(of_window * alive_BU, -1) / alive_BU.sum(-1)

    error, of_mean = mean((guess - truth) ** 2), mean(truth**2)
    some = alive_BU.any(-1) if judged_BT is None else alive_BU.any(-1) & judged_BT[:, first:].any(1)
    metrics = {"action_error": error, "action_error_of_mean": of_mean, "action_gain": of_mean - error}
    return metrics | {"finite": jnp.isfinite(error) | ~some}
