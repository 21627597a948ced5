"""Cases of the discrete model that predicts actions too: given, hidden, in training, as a policy."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from tests.golden.case import Case, norms
from tests.golden.discrete import MASKING, Decoder, as_masked, check_channels_first, loss_and_accuracy, windows


def check_joint(case: Case) -> None:
    ids, masked = windows(case, "tokens")
    batch = len(ids)
    everything = np.ones(ids.shape[:2], bool)
    unnormalise = jax.jit(case.table.scale().unnormalise)

    @jax.jit
    def read(params, actions, robots, hidden):
        model = case.declared.merge(params)
        out = model(ids, masked, actions, robots, action_hidden_BT=hidden)
        return out.token_outputs, model.action_head(out.action_features_BTD, robots)

    for robot in case.domains:
        robots, chunk = case.robot(robot, batch), case.table.entries[case.table.index(robot)].chunk
        for way, hidden in (("given", ~everything), ("policy", everything)):
            logits, predicted = read(case.params, case.actions(robot), robots, hidden)
            check_channels_first(case, f"states_{way}__{robot}", logits)
            case.check(f"actions_{way}__{robot}", np.asarray(predicted)[..., :chunk])
        raw = np.asarray(unnormalise(predicted, robots))
        case.check(f"actions_policy_unnormalized__{robot}", raw[..., :chunk])
    if "train_loss" in case.outputs:
        _check_training(case)
    if "generate_policy_tokens" in case.outputs:
        _check_policy(case, everything)


def _check_policy(case: Case, everything: np.ndarray) -> None:
    """Frames and actions of a window whose actions are all hidden."""
    tokens, _ = windows(case, "clean_tokens")
    batch = len(tokens)
    robot, prompt = case.domains[0], case.info["num_prompt"]
    nothing = np.zeros_like(case.actions(robot))
    window, _, out = Decoder(case, nothing, everything).generate(tokens, prompt, 1, [])
    case.check("generate_policy_tokens", window.reshape(batch, -1))
    robots = case.robot(robot, batch)

    @jax.jit
    def read(params, features):
        return case.table.scale().unnormalise(case.declared.merge(params).action_head(features, robots), robots)

    raw = np.asarray(read(case.params, out.action_features_BTD))
    chunk = case.table.entries[case.table.index(robot)].chunk
    case.check("generate_policy_actions_unnormalized", raw[..., :chunk])


def _check_training(case: Case) -> None:
    """As released: hidden actions go on modulating, and the action loss is the mean squared error to
    raw actions times the mean of the mask."""
    ids, masked = windows(case, "input_ids")
    labels, _ = windows(case, "labels")
    robot, batch = case.domains[0], len(ids)
    actions, robots = case.actions(robot), case.robot(robot, batch)
    chunk = case.table.entries[case.table.index(robot)].chunk
    hidden = (case.inputs["action_mask_draw"] < case.inputs["action_drop_ratio"])[..., 0]
    masking = replace(MASKING, setting="full", action_leak="conditioning")
    weight = case.settings["action_loss_weight"]
    recorded = as_masked(ids, masked, hidden)

    @jax.jit
    def gradient(params):
        def total(p):
            model = case.declared.merge(p)
            loss, accuracy = loss_and_accuracy(model, recorded, labels, actions, robots, masking)
            out = model(ids, masked, actions, robots, action_hidden_BT=hidden, leak=masking.action_leak)
            predicted = model.action_head(out.action_features_BTD, robots)[..., :chunk]
            action_loss = jnp.mean((actions[..., :chunk] - predicted) ** 2) * jnp.mean(hidden.astype(jnp.float32))
            return loss + weight * action_loss, (loss, accuracy, action_loss, predicted, out.token_outputs)

        return jax.grad(total, has_aux=True)(params)

    grads, (loss, accuracy, action_loss, predicted, logits) = gradient(case.params)
    case.check("train_loss", loss)
    case.check("train_acc", accuracy)
    case.check("train_action_loss", action_loss)
    case.check("train_actions", predicted)
    check_channels_first(case, "train_logits", logits)
    case.check("train_action_mask", hidden[..., None])
    named = case.official(grads)
    case.check_group("grad", named)
    case.check_group("gradnorm", norms(named))
    case.check_zero(named, case.info["unused_parameters"])
