"""HMA as a policy, past its window."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.applications.policies.own_head import OwnHeadPolicy
from hma_jax.config import ConfigError, MaskingConfig, TrainConfig
from hma_jax.simulator.folder import DEFAULT_DECODE, change_decode
from tests.hma_jax.simulator.small import ROBOTS, latent_parts, parts


def test_it_acts_longer_than_its_window_and_then_sees_only_the_last_frames():
    model, tokenizer = parts()
    model = replace(model, run=replace(model.run, train=TrainConfig(masking=MaskingConfig(setting="full"))))
    frames = np.random.default_rng(0).integers(0, 256, (7, 2, 8, 8, 3), np.uint8)
    policy = OwnHeadPolicy(model, tokenizer, ROBOTS[1])
    acted = np.stack([policy.act(images) for images in frames])
    low, high = np.array(ROBOTS[1].low, np.float32), np.array(ROBOTS[1].high, np.float32)
    assert acted.shape == (7, 2, 2, 7) and ((acted >= low) & (acted <= high)).all()  # whole chunks of two actions
    assert not np.array_equal(acted[0, 0], acted[0, 1]) and not np.array_equal(acted[:, :, 0], acted[:, :, 1])
    for b in range(2):  # and they are what it remembers
        np.testing.assert_array_equal(policy._chunks[b][-1][:14], acted[6, b].ravel())

    # An episode begun at frame 0 of other images, with what it saw and did in its last window put in its place.
    other = OwnHeadPolicy(model, tokenizer, ROBOTS[1])
    other.act(frames[0, ::-1])
    other._tokens = [list(tokens[:-1]) for tokens in policy._tokens]
    other._chunks = [list(chunks[:-1]) for chunks in policy._chunks]
    np.testing.assert_allclose(other.act(frames[6]), acted[6], rtol=1e-5)

    policy.reset(np.flatnonzero([True, False]))  # an array of 0, whose truth value is false
    again = policy.act(np.stack([frames[0, 0], frames[0, 1]]))
    np.testing.assert_allclose(again[0], acted[0, 0], rtol=1e-5)
    assert not np.array_equal(again[1], acted[0, 1])


def test_a_model_on_latents_acts_greedily():
    """Its actions were draws, whatever the decoding said, and a noising process of less than 100 steps was an error."""
    model, tokenizer = latent_parts()
    model = replace(model, run=replace(model.run, train=TrainConfig(masking=MaskingConfig(setting="policy"))))
    images = np.full((3, 8, 8, 3), 99, np.uint8)
    for decode, kinds in (((), 1), ((change_decode(DEFAULT_DECODE, temperature=1.0),), 3)):
        policy = OwnHeadPolicy(model, tokenizer, ROBOTS[1], *decode)
        policy.reset(seeds=[0, 1, 2])
        assert len(np.unique(policy.act(images), axis=0)) == kinds


@pytest.mark.parametrize(("heads", "setting"), [(False, "full"), (True, "forward"), (True, "inverse")])
def test_a_model_that_was_not_trained_to_act_is_no_policy(heads, setting):
    model, tokenizer = parts()
    train = TrainConfig(masking=MaskingConfig(setting=setting))
    other = replace(model, run=replace(model.run, train=train, model=replace(model.config, action_heads=heads)))
    with pytest.raises(ConfigError, match=f"'{setting}', so it cannot act as a policy; .* and model.action_heads=true"):
        OwnHeadPolicy(other, tokenizer, ROBOTS[0])
