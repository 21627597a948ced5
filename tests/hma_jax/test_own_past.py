"""A past that the model drew itself: which frames it replaces, and with what."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, MaskingConfig
from hma_jax.config.training import ActionLeak
from hma_jax.generation.teacher import next_frame_outputs
from hma_jax.model.frames import compose, factorise
from hma_jax.model.readout import choose_likeliest
from hma_jax.model.teacher_forcing import teacher_forced_pass
from hma_jax.objective import losses, own_past
from hma_jax.objective.losses import noise_keys
from hma_jax.objective.masking import mask_batch
from hma_jax.objective.own_past import draw_own_past
from tests.tiny import TABLE, lively_params, mask, random_batch, shallow_config

TRUE = MaskingConfig(teacher_forcing=True, min_ratio=1.0, max_corrupt_rate=0.0, non_mlm_ratio=0.0)
OWN = MaskingConfig(teacher_forcing=True, min_ratio=1.0, max_corrupt_rate=0.0, non_mlm_ratio=0.0, own_past=1.0)


def test_frames_are_replaced_by_what_the_model_says_of_them_and_the_first_never(monkeypatch):
    config = shallow_config(action_heads=False)
    declared, params = lively_params(config, scale=0.5)
    model, rows = declared.merge(params), 128
    one = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[:1], rows, 0), random_batch(0, config, 1))
    before, given = one["tokens"][:, :-1], (one["actions"], one["embodiment"])
    keys = noise_keys(jax.random.key(0), rows)
    draw = jax.jit(
        lambda share: draw_own_past(
            model, before, *given, None, share=share, rounds=1, key_B=keys, robot_row_B=given[1]
        )
    )
    drawn = np.asarray(draw(1.0))
    assert (drawn[:, 0] == before[:, 0]).all()
    replaced = (drawn != np.asarray(before)).any(-1)[:, 1:]
    assert 0.42 < replaced.mean() < 0.58  # u is uniform: half of all frames
    assert replaced.mean(1).std() > 0.2  # and drawn for each example
    # Of a frame that is replaced, each factor is as frequent as the model says after the true past.
    first = one["tokens"][:1], *(x[:1] for x in given)
    predictions = jax.jit(lambda *x: jax.nn.softmax(next_frame_outputs(model, *x)[0, 0]))(*first)
    own = factorise(jnp.asarray(drawn[replaced[:, 0], 1]), config.factors, config.factor_vocab)
    frequency = jax.nn.one_hot(own, config.factor_vocab).mean(0)
    assert np.abs(np.asarray(frequency - predictions)).max() < 0.2
    assert np.corrcoef(np.ravel(frequency), np.ravel(predictions))[0, 1] > 0.8
    np.testing.assert_array_equal(draw(0.0), before)

    # The loss is that of what follows this past.
    shown, own = [], before + 1
    monkeypatch.setattr(losses, "draw_own_past", lambda *_, **__: own)

    def recording_pass(model, past, *rest, **how):
        shown.append(past)
        return teacher_forced_pass(model, past, *rest, **how)

    monkeypatch.setattr(losses, "teacher_forced_pass", recording_pass)

    def loss(masking: MaskingConfig) -> jax.Array:
        masked = mask_batch(jax.random.key(0), one["tokens"], one["embodiment"], config, masking, TABLE)
        return losses.masked_loss(model, masked, one["tokens"], *given, masking, keys, training=True).tokens

    jax.eval_shape(lambda: loss(OWN))
    jax.eval_shape(lambda: loss(TRUE))
    assert shown[0] is own and shown[1] is not own


def test_each_round_gathers_the_errors_of_one_frame_more_until_all_is_a_rollout(monkeypatch):
    """Where the likeliest ids are taken, the first r frames of r rounds each are what the model says after its own."""
    monkeypatch.setattr(own_past, "choose_sampled", lambda *_: choose_likeliest)
    config = shallow_config(action_heads=False, frames=4)
    declared, params = lively_params(config, scale=0.5)
    model, rows = declared.merge(params), 8
    batch = random_batch(0, config, rows)
    before, given = jnp.asarray(batch["tokens"])[:, :-1], (batch["actions"], batch["embodiment"])
    every_frame, frames = 1e9, before.shape[1]  # of each example u times this, above 1 for any u

    @partial(jax.jit, static_argnums=0)
    def own_share(rounds: int) -> jax.Array:
        """Of each frame, the share of ids that the model says after the frames before it in what is drawn."""
        keys = noise_keys(jax.random.key(0), rows)
        past = draw_own_past(
            model, before, *given, None, share=every_frame, rounds=rounds, key_B=keys, robot_row_B=given[1]
        )
        whole = jnp.concatenate([past, past[:, -1:]], axis=1)
        digits, _ = model.frame_head.decode_factors(next_frame_outputs(model, whole, *given), choose_likeliest)
        predictions = compose(digits, config.factor_vocab)[:, : frames - 1]
        return (predictions == past[:, 1:]).mean((0, 2))

    shares = [own_share(rounds) for rounds in range(1, frames)]
    for rounds, share in enumerate(shares, start=1):
        assert (share[:rounds] == 1).all()
    assert shares[0][1] < 0.9


def test_every_round_draws_with_random_numbers_of_its_own(monkeypatch):
    """Where the model says nothing, rounds of the same numbers would draw the same ids."""
    config = shallow_config(action_heads=False)
    declared, params = lively_params(config)
    batch, every_frame = random_batch(0, config, 4), 1e9
    before, given = jnp.asarray(batch["tokens"])[:, :-1], (batch["actions"], batch["embodiment"])
    nothing = SimpleNamespace(token_outputs=jnp.zeros((*before.shape, config.factors, config.factor_vocab)))
    monkeypatch.setattr(own_past, "teacher_forced_pass", lambda *_, **__: nothing)

    @jax.jit
    def draw(keys):
        model = declared.merge(params)
        options = dict(share=every_frame, key_B=keys, robot_row_B=given[1])
        return [draw_own_past(model, before, *given, None, rounds=rounds, **options) for rounds in (1, 2, 3)]

    first, second, third = draw(noise_keys(jax.random.key(0), 4))
    for one, other in ((first, second), (second, third), (first, third)):
        assert (one[:, 1:] != other[:, 1:]).mean() > 0.9


def test_it_needs_a_past_that_is_shown():
    with pytest.raises(ConfigError, match="own_past needs masking.teacher_forcing=true"):
        MaskingConfig(own_past=0.5)
    with pytest.raises(ConfigError, match="own_past_rounds must be at least 1, got 0"):
        MaskingConfig(own_past_rounds=0)
    with pytest.raises(ConfigError, match="own_past_rounds 3 has no effect while masking.own_past is 0"):
        MaskingConfig(teacher_forcing=True, own_past_rounds=3)


def test_it_is_drawn_after_hidden_actions_where_these_leak_to_the_model(monkeypatch):
    """As the frames that follow it are predicted."""
    monkeypatch.setattr(own_past, "choose_sampled", lambda *_: choose_likeliest)
    config = shallow_config(action_heads=False)
    declared, params = lively_params(config, scale=0.5)
    batch = random_batch(0, config, 8)
    tokens, given = jnp.asarray(batch["tokens"]), (batch["actions"], batch["embodiment"])
    hidden, keys = jnp.ones(tokens.shape[:2], bool), noise_keys(jax.random.key(0), 8)

    @partial(jax.jit, static_argnums=1)
    def past(hidden: jax.Array | None, leak: ActionLeak) -> jax.Array:
        options = dict(share=1.0, rounds=1, key_B=keys, robot_row_B=given[1], leak=leak)
        return draw_own_past(declared.merge(params), tokens[:, :-1], *given, hidden, **options)

    np.testing.assert_array_equal(past(hidden, "all"), past(None, "none"))
    assert (past(hidden, "none") != past(None, "none")).any()

    seen = []
    monkeypatch.setattr(losses, "draw_own_past", lambda model, past, *_, leak, **__: seen.append(leak) or past)
    masking = replace(OWN, action_leak="all")
    masked = mask(jax.random.key(0), tokens, given[1], config, masking, TABLE)
    jax.eval_shape(
        lambda: losses.masked_loss(declared.merge(params), masked, tokens, *given, masking, keys, training=True).tokens
    )
    assert seen == ["all"]
