"""Which actions the model of an evaluation is shown."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.evaluation import protocol
from tests.hma_jax.evaluation.fakes import make_batches
from tests.hma_jax.evaluation.test_evaluate import CONFIG, EVAL
from tests.tiny import TABLE, lively_params


@pytest.fixture(scope="module")
def params():
    return lively_params(CONFIG)[1]


@pytest.mark.parametrize(("context", "marked"), [("generated", False), ("recorded", False), ("recorded", True)])
def test_a_model_that_was_trained_without_actions_is_shown_none(context, marked, params, monkeypatch):
    """Neither recorded ones nor those at random, between which untrained stems would make a difference."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    hidden, logits = [], (CONFIG.tokens, CONFIG.factors, CONFIG.factor_vocab)

    def outputs(model, tokens, *rest):
        hidden.append(rest[-1])
        return jnp.zeros((len(tokens), tokens.shape[1] - 1, *logits))

    def made(model, tokens, *rest):
        return outputs(model, tokens, *rest), jnp.zeros_like(tokens[:, 1:])

    def rolled_out(_, prompt, sequences, *__, action_hidden_BT):
        hidden.append(action_hidden_BT)
        return jnp.zeros((*sequences.shape[:2], CONFIG.frames - prompt.shape[1], CONFIG.tokens), jnp.int32)

    monkeypatch.setattr(protocol, "rollout", rolled_out)
    monkeypatch.setattr(protocol, "next_frames", made)
    monkeypatch.setattr(protocol, "next_frame_outputs", outputs)
    inputs = {name: batch[name] for name in ("tokens", "actions", "embodiment", "episode", "start")}
    if marked:
        inputs["real"] = np.ones(batch["tokens"].shape[:2], bool)
    protocol.make_predictor(CONFIG, TABLE, replace(EVAL, context=context), "passive")(params, inputs)
    assert len(hidden) == 2 and all(marks is not None and marks.all() for marks in hidden)


def test_another_episode_s_actions_begin_with_the_chunk_that_leads_to_the_first_predicted_frame(params, monkeypatch):
    """Those before it led to the frames of the prompt."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    seen = []

    def rolled_out(_, prompt, sequences, *__, **___):
        seen.append(sequences)
        return jnp.zeros((*sequences.shape[:2], 4, 9), jnp.int32)

    losses = {"cross_entropy": jnp.zeros((3, 4)), "finite": jnp.ones((3, 4), bool)}
    monkeypatch.setattr(protocol, "rollout", rolled_out)
    monkeypatch.setattr(protocol, "for_each_sequence", lambda *_: losses)
    other = np.full((4, 2, *batch["actions"].shape[1:]), 9, np.float32)
    inputs = batch | {"other_actions": other, "other_valid": np.ones((4, 2), bool), "other_images": batch["images"]}
    protocol.make_predictor(CONFIG, TABLE, EVAL)(params, {k: v for k, v in inputs.items() if k != "dataset"})
    (sequences,) = seen
    first = EVAL.first_predicted - 1
    np.testing.assert_array_equal(sequences[:, -1, :first], batch["actions"][:, :first])
    np.testing.assert_array_equal(sequences[:, -1, first:], other[:, 0, first:])
