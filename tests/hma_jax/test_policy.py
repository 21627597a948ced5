"""Actions predicted for a recorded window, beside one window for each frame."""

import jax
import numpy as np
import pytest

from hma_jax.config import DecodeConfig
from hma_jax.generation import predict_actions, predict_next_actions
from tests.tiny import lively_params, model_config, random_batch


@pytest.mark.parametrize("alignment", ["released", "causal"])
def test_next_actions_equal_one_window_per_frame_with_the_rest_hidden(alignment: str):
    config = model_config(action_alignment=alignment)
    declared, params = lively_params(config, scale=0.1)
    batch = random_batch(0, config, 2)
    keys = jax.random.split(jax.random.key(0), 2)
    args = (batch["tokens"], batch["actions"], batch["embodiment"])
    fast = jax.jit(lambda p: predict_next_actions(declared.merge(p), *args, keys, DecodeConfig()))(params)
    one = jax.jit(lambda p, h: predict_actions(declared.merge(p), *args, h, keys, DecodeConfig()))
    for t in range(config.frames):
        hidden = np.broadcast_to(np.arange(config.frames) >= t, (2, config.frames))
        slow = one(params, hidden)[:, t]
        np.testing.assert_allclose(fast[:, t], slow, atol=1e-4 * np.abs(slow).max())


@pytest.mark.parametrize("alignment", ["released", "causal"])
def test_a_policy_never_sees_what_it_predicts(alignment: str):
    config = model_config(action_alignment=alignment)
    declared, params = lively_params(config)
    batch = random_batch(0, config, 2)
    keys = jax.random.split(jax.random.key(0), 2)
    changed = dict(batch, tokens=batch["tokens"].copy(), actions=batch["actions"].copy())
    changed["actions"][:, 3:] += 5.0
    changed["tokens"][:, 4:] = (changed["tokens"][:, 4:] + 1) % config.vocab_size
    hidden = np.broadcast_to(np.arange(6) >= 3, (2, 6))
    predict = jax.jit(
        lambda b: predict_actions(
            declared.merge(params), b["tokens"], b["actions"], b["embodiment"], hidden, keys, DecodeConfig()
        )
    )
    a, b = predict(batch), predict(changed)
    np.testing.assert_array_equal(a[:, :4], b[:, :4])
    assert np.abs(a[:, 4:] - b[:, 4:]).max() > 1e-3
