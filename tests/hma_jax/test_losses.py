"""The terms of the loss: what is compared with what, and over what their means are."""

from types import SimpleNamespace
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import MaskingConfig, MaskingSetting
from hma_jax.model.hma import declare_model
from hma_jax.objective.losses import action_loss_per_step, masked_loss
from tests.hma_jax.test_masking import MIXED, masked_batch
from tests.tiny import DIFFUSION, TABLE, random_batch, shallow_config

KEYS = jax.random.split(jax.random.key(0), 8)


def test_labels_are_smoothed_by_as_much_as_is_configured(monkeypatch):
    config, masking, seen = shallow_config(), MaskingConfig(label_smoothing=0.3), []

    def cross_entropy(logits, labels, smoothing):
        seen.append(smoothing)
        return jnp.zeros(logits.shape[:-2]), jnp.zeros(logits.shape[:-2], bool)

    monkeypatch.setattr("hma_jax.objective.losses.smoothed_cross_entropy", cross_entropy)
    declared, (data, masked) = declare_model(config, TABLE), masked_batch(config, masking, batch=8)
    inputs = masked, data["tokens"], data["actions"], data["embodiment"], masking, KEYS
    jax.eval_shape(lambda params: masked_loss(declared.merge(params), *inputs, training=True), declared.shapes())
    assert seen == [0.3]


def hidden_from_model(masking, table=TABLE):
    """(bool [B, T], which chunks are hidden; the same as the model is told; each one's robot)."""

    class Told(Exception):
        pass

    def align_hidden(hidden, shape):
        raise Told(hidden)

    data, masked = masked_batch(shallow_config(), masking, table)
    inputs = masked, data["tokens"], data["actions"], data["embodiment"], masking, jax.random.split(KEYS[0], 64)
    model = SimpleNamespace(table=table, align=lambda actions: actions, align_hidden=align_hidden)
    with pytest.raises(Told) as told:
        masked_loss(model, *inputs, training=True)
    return masked.action_hidden_T, *told.value.args, data["embodiment"]


@pytest.mark.parametrize("setting", get_args(MaskingSetting))
def test_whatever_a_setting_hides_is_hidden_from_the_model(setting):
    """The model is told of no chunks (None) only where none is hidden."""
    hidden, told, _ = hidden_from_model(MaskingConfig(setting=setting))
    np.testing.assert_array_equal(hidden, np.zeros_like(hidden) if told is None else told)


@pytest.mark.parametrize("teacher_forcing", [False, True])
def test_robots_without_actions_are_shown_none_where_others_are_shown_theirs(teacher_forcing):
    """As at inference: zeros that were shown in training alone would be another input."""
    _, told, robots = hidden_from_model(MaskingConfig(teacher_forcing=teacher_forcing), MIXED)
    np.testing.assert_array_equal(np.all(told, axis=1), np.array(MIXED.chunks)[robots] == 0)


def action_losses(config, action_head):
    """(losses, the head's first argument, robots) of `action_head(target, *its arguments)` in a model's place."""
    batch, normalise = random_batch(0, config), TABLE.scale().normalise

    @jax.jit
    def run(actions, robots):
        target, seen = normalise(actions, robots), []

        def head(*given):
            seen.append(given[0])
            return action_head(target, *given)

        model = SimpleNamespace(config=config, table=TABLE, normalise=normalise, action_head=head)
        features = jnp.zeros((*actions.shape[:2], 1))
        return action_loss_per_step(model, features, actions, robots, robots, KEYS), seen[0]

    return *run(batch["actions"], batch["embodiment"]), batch["embodiment"]


def test_the_error_of_actions_is_the_mean_over_a_robot_s_own_live_values():
    """However wide the widest robot's are."""
    error, *_ = action_losses(shallow_config(), lambda target, *_: target + 2)
    np.testing.assert_allclose(error, 4, rtol=1e-5)


def test_action_values_without_a_signal_are_not_noised():
    """As where actions are sampled (`generation.policy`): else what is learnt would depend on the widest robot."""

    def head(target, x, time, *_):
        return jnp.zeros((*x.shape[:-1], 2 * x.shape[-1]))

    _, noised, robots = action_losses(shallow_config(diffusion=DIFFUSION), head)
    np.testing.assert_array_equal(
        np.asarray(noised) != 0, np.broadcast_to(TABLE.alive()[robots][:, None], noised.shape)
    )
