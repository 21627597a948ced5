"""Which actions are hidden from the model, and which of them it is to predict."""

import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import MaskingConfig
from hma_jax.objective.masking import hidden_at_inference
from tests.hma_jax.test_masking import MIXED, masked_batch
from tests.tiny import TABLE, shallow_config


def test_a_policy_s_hidden_actions_are_all_from_one_frame_on():
    _, masked = masked_batch(shallow_config(), MaskingConfig(setting="policy"))
    hidden = np.asarray(masked.action_hidden_T)
    assert (np.diff(hidden.astype(int), axis=1) >= 0).all() and hidden[:, -1].all()
    assert len(np.unique(hidden.sum(1))) == 6


FULL = MaskingConfig(setting="full", non_mlm_ratio=0.0)


def test_every_example_draws_how_many_of_its_actions_are_hidden():
    """Of six, at rates that are uniform, none and all are as likely as three."""
    _, masked = masked_batch(shallow_config(), FULL, batch=512)
    hidden = np.asarray(masked.action_hidden_T).sum(1)
    np.testing.assert_allclose(np.bincount(hidden, minlength=7) / 512, 1 / 7, atol=0.06)


def test_how_many_actions_are_hidden_says_nothing_of_how_many_ids_are_corrupted():
    """Each has random numbers of its own."""
    data, masked = masked_batch(shallow_config(), FULL, batch=512)
    corrupted = (np.asarray(masked.inputs) != data["tokens"]).mean((1, 2))
    assert abs(np.corrcoef(corrupted, np.asarray(masked.action_hidden_T).mean(1))[0, 1]) < 0.15


@pytest.mark.parametrize("setting", ["full", "policy"])
def test_where_no_frame_is_shown_the_chunk_that_follows_it_all_chunks_are_predicted(setting: str):
    config = shallow_config(action_alignment="causal")
    data, masked = masked_batch(config, MaskingConfig(setting=setting), MIXED)
    film = data["embodiment"] == MIXED.index("film")  # which has none
    np.testing.assert_array_equal(masked.action_targets_T, np.tile(~film[:, None], config.frames))


def test_chunks_that_training_never_shows_are_hidden_at_inference():
    robots = jnp.array([0, 1, 2, 1])
    hidden = hidden_at_inference(MIXED, "forward", robots, 3)
    assert hidden.tolist() == [[False] * 3, [True] * 3, [False] * 3, [True] * 3]
    assert hidden_at_inference(TABLE, "forward", robots[:1], 3) is None
    assert hidden_at_inference(TABLE, "passive", robots[:1], 3).tolist() == [[True] * 3]
