"""Actions that a model chooses, beside one window for each frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import DecodeConfig, SamplerConfig
from hma_jax.generation import predict_actions, predict_next_actions, rollout_naive, rollout_policy
from tests.tiny import DIFFUSION, SMALLER, lively_params, model_config, random_batch

LONG = (pytest.mark.exact, pytest.mark.slow)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(SMALLER | {"action_alignment": "causal"}, id="smallest"),
        pytest.param({"action_alignment": "causal", "frames": 5}, id="causal-discrete", marks=LONG),
        pytest.param({"diffusion": DIFFUSION, "frames": 5}, id="released-continuous", marks=LONG),
    ],
)
def test_a_policy_rollout_is_what_acting_and_imagining_by_turns_gives(changes):
    """The cached loop against whole-window calls of `predict_actions` and `rollout_naive`."""
    config = model_config(**changes)
    declared, params = lively_params(config, scale=0.05)
    batch = random_batch(0, config, 2)
    keys = jax.random.split(jax.random.key(0), 2)
    decode = DecodeConfig(1, sampler=SamplerConfig(steps=4, temperature=0.0))
    robots = batch["embodiment"]
    prompt = batch["tokens"][:, : max(config.frames - 3, 1)]

    @jax.jit
    def by_itself(params):
        return rollout_policy(declared.merge(params), prompt, batch["actions"], robots, keys, decode)

    @jax.jit
    def by_turns(params):
        hma, window, actions = declared.merge(params), jnp.asarray(prompt), jnp.asarray(batch["actions"])
        for t in range(prompt.shape[1], config.frames):
            hidden = jnp.broadcast_to(jnp.arange(t) >= t - 1, (2, t))
            chosen = predict_actions(hma, window, actions[:, :t], robots, hidden, keys, decode)[:, t - 1]
            actions = actions.at[:, t - 1].set(chosen)
            unknown = jnp.broadcast_to(jnp.arange(t + 1) >= t, (2, t + 1))
            new = rollout_naive(hma, window, actions[:, : t + 1], robots, keys, decode, action_hidden_BT=unknown)
            window = jnp.concatenate([window, new], axis=1)
        return window[:, prompt.shape[1] :], actions

    (frames, chunks), (imagined, chosen) = by_itself(params), by_turns(params)
    np.testing.assert_allclose(chunks, chosen, atol=1e-3)
    np.testing.assert_allclose(frames, imagined, atol=1e-3)


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
