"""Training on frames that are predicted from their true past: what it asks is what generation is asked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, MaskingConfig
from hma_jax.generation.teacher import next_frame_outputs
from hma_jax.model.frames import factorise
from hma_jax.model.hma import HMA
from hma_jax.model.teacher_forcing import teacher_forced_pass
from hma_jax.objective.losses import frame_diffusion_loss, masked_loss, noise_keys, smoothed_cross_entropy
from hma_jax.objective.masking import mask_batch
from tests.tiny import DIFFUSION, TABLE, lively_params, random_batch, shallow_config

WHOLLY = MaskingConfig(teacher_forcing=True, min_ratio=1.0, max_corrupt_rate=0.0, non_mlm_ratio=0.0)


def make(**changes) -> tuple[HMA, dict[str, jax.Array]]:
    config = shallow_config(action_heads=False, **changes)
    declared, params = lively_params(config)
    return declared.merge(params), jax.tree.map(jnp.asarray, random_batch(0, config, 3))


@pytest.mark.parametrize(
    ("diffusion", "alignment"),
    [
        (None, "causal"),
        (DIFFUSION, "released"),
        pytest.param(None, "released", marks=pytest.mark.slow),
        pytest.param(DIFFUSION, "causal", marks=pytest.mark.slow),
    ],
)
def test_of_wholly_masked_frames_it_is_the_loss_of_what_generation_is_asked_first(diffusion, alignment):
    model, batch = make(diffusion=diffusion, action_alignment=alignment)
    tokens, rest = batch["tokens"], (batch["actions"], batch["embodiment"])
    key = jax.random.key(0)
    keys = noise_keys(key, 3)

    @jax.jit
    def found():
        masked = mask_batch(key, tokens, batch["embodiment"], model.config, WHOLLY, TABLE)
        return masked.targets_TS, masked_loss(model, masked, tokens, *rest, WHOLLY, keys, training=True).tokens

    @jax.jit
    def wanted():
        asked = next_frame_outputs(model, tokens, *rest)
        if diffusion:
            return frame_diffusion_loss(model, asked, tokens[:, 1:], keys, training=False).sum()
        labels = factorise(tokens[:, 1:], model.config.factors, model.config.factor_vocab)
        return smoothed_cross_entropy(asked, labels, WHOLLY.label_smoothing)[0].sum()

    targets, loss = found()
    assert targets[:, 1:].all()
    np.testing.assert_allclose(loss, wanted(), rtol=1e-5)


def test_a_frame_is_told_the_frames_before_it_and_not_their_masks():
    model, batch = make()
    tokens, rest = batch["tokens"], (batch["actions"], batch["embodiment"])
    some = jax.random.bernoulli(jax.random.key(1), 0.5, tokens[:, 1:].shape)

    @jax.jit
    def said(before: jax.Array, masked: jax.Array) -> jax.Array:
        return teacher_forced_pass(model, before, tokens[:, 1:], masked, *rest).token_outputs

    shown = said(tokens[:, :-1], some)
    other_masks = said(tokens[:, :-1], some.at[:, 0].set(~some[:, 0]))
    np.testing.assert_array_equal(other_masks[:, 1:], shown[:, 1:])
    assert (other_masks[:, 0] != shown[:, 0]).any()
    other_past = said(tokens[:, :-1].at[:, 1].set(0), some)
    np.testing.assert_array_equal(other_past[:, 0], shown[:, 0])
    assert (other_past[:, 1:] != shown[:, 1:]).any(axis=(0, 2, 3, 4)).all()


@pytest.mark.parametrize("diffusion", [None, DIFFUSION], ids=["ids", "latents"])
def test_what_a_masked_token_recalls_is_the_frame_before_and_never_the_truth(diffusion):
    model, batch = make(diffusion=diffusion, recall=True)
    tokens, rest = batch["tokens"], (batch["actions"], batch["embodiment"])
    before, masked = tokens[:, :-1], jnp.ones(tokens[:, 1:].shape[:3], bool)

    @jax.jit
    def said(before: jax.Array, ahead: jax.Array) -> jax.Array:
        return teacher_forced_pass(model, before, ahead, masked, *rest).token_outputs

    told = said(before, tokens[:, 1:])
    np.testing.assert_array_equal(said(before, jnp.zeros_like(before)), told)
    # With temporal attention and the rest of the past cut away, the last frame alone still reaches the one after it.
    other = said(before.at[:, -1].set(0), tokens[:, 1:])
    np.testing.assert_array_equal(other[:, :-1], told[:, :-1])
    assert (other[:, -1] != told[:, -1]).any()


def test_in_one_pass_over_masked_frames_only_what_is_shown_is_recalled():
    model, batch = make(recall=True)
    tokens, rest = batch["tokens"], (batch["actions"], batch["embodiment"])
    masked = jnp.zeros(tokens.shape, bool).at[:, 2:].set(True)

    @jax.jit
    def said(tokens: jax.Array) -> jax.Array:
        return model(tokens, masked, *rest).token_outputs

    np.testing.assert_array_equal(said(tokens.at[:, 2:].set(0)), said(tokens))
    changed = said(tokens.at[:, 1].set(0)) != said(tokens)
    assert changed[:, 2].any()


def test_nothing_that_is_hidden_of_a_partly_masked_token_is_recalled():
    model, batch = make(diffusion=DIFFUSION, recall=True)
    tokens, rest = batch["tokens"], (batch["actions"], batch["embodiment"])
    cells = jnp.zeros((*tokens.shape[:3], DIFFUSION.cells), bool).at[:, 2, :, 0].set(True).at[:, 3:].set(True)
    hidden = jnp.repeat(cells, DIFFUSION.channels, axis=-1)

    @jax.jit
    def said(tokens: jax.Array) -> jax.Array:
        return model(tokens, cells, *rest).token_outputs

    np.testing.assert_array_equal(said(jnp.where(hidden, tokens + 1, tokens)), said(tokens))


@pytest.mark.parametrize("setting", ["full", "policy", "inverse"])
def test_settings_that_predict_actions_are_refused(setting):
    with pytest.raises(ConfigError, match=f"teacher_forcing works only with settings .* '{setting}' predicts actions"):
        MaskingConfig(setting=setting, teacher_forcing=True)
