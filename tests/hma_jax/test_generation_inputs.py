"""What rollouts, sessions and teacher forcing take, and what they refuse in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig
from hma_jax.generation import (
    advance,
    next_frame_outputs,
    next_frames,
    predict_actions,
    predict_next_actions,
    rollout,
    start,
)
from tests.tiny import SMALLER, TABLE, lively_params, model_config, random_batch, shallow_config


@pytest.mark.parametrize(
    ("prompt", "actions", "robots", "message"),
    [
        ((1, 2), (1, 1, 2), 1, "action chunks for more frames than the prompt has, got 2"),
        ((1, 0), (1, 1, 4), 1, "needs at least 1 prompt frame, got 0"),
        ((1, 2), (1, 4), 1, r"a prompt \[B, T', 9\], actions \[B, R, T, 14\] .*; got \(1, 2, 9\), \(1, 4, 14\), "),
        ((1, 2), (1, 1, 4), 2, r"takes a prompt .*; got \(1, 2, 9\), \(1, 1, 4, 14\), \(2,\), \(1,\)$"),
    ],
)
def test_a_rollout_of_other_shapes_is_refused(prompt, actions, robots, message):
    config = model_config()
    declared, params = lively_params(config)
    with pytest.raises(ConfigError, match=message):
        rollout(
            declared.merge(params),
            np.zeros((*prompt, config.tokens), np.int32),
            np.zeros((*actions, TABLE.action_width), np.float32),
            np.zeros(robots, np.int32),
            jax.random.split(jax.random.key(0), 1),
            DecodeConfig(),
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prompt": np.full((1, 2, 9), 64)}, "got ids from 64 to 64, but the model allows 0 to 63"),
        ({"prompt": np.zeros((1, 2, 9))}, "this model's frames are int32, got float64"),
        ({"robots": np.array([3])}, "got robots from 3 to 3, but the model allows 0 to 2"),
        ({"robots": np.array([-1])}, "got robots from -1 to -1, but the model allows 0 to 2"),
        ({"robots": np.zeros(1)}, "robots are integers, positions in the model's table; got float64"),
        ({"actions": np.full((1, 1, 4, 14), np.nan)}, "the actions are not finite"),
        ({"keys": jax.random.split(jax.random.PRNGKey(0), 1)}, r"1 keys are needed, .*got uint32 \(1, 2\); `jax"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_values_that_a_model_does_not_know_are_refused(changes, message):
    """JAX computed frames from them, or raised an internal error."""
    config = shallow_config()
    declared, params = lively_params(config)
    given = dict(
        prompt=np.zeros((1, 2, 9), np.int32),
        actions=np.zeros((1, 1, 4, 14), np.float32),
        robots=np.zeros(1, np.int32),
        keys=jax.random.split(jax.random.key(0), 1),
    )
    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(lambda p: rollout(declared.merge(p), *(given | changes).values(), DecodeConfig()), params)


def test_ids_of_any_whole_type_are_continued():
    config = shallow_config()
    declared, params = lively_params(config)
    made = jax.eval_shape(
        lambda p: rollout(
            declared.merge(p),
            np.zeros((1, 2, 9), np.uint8),
            np.zeros((1, 1, 4, 14), np.float32),
            np.zeros(1, np.int32),
            jax.random.split(jax.random.key(0), 1),
            DecodeConfig(),
        ),
        params,
    )
    assert made.dtype == np.int32 and made.shape == (1, 1, 2, 9)


@pytest.mark.parametrize(
    ("tokens", "between", "chunk", "message"),
    [
        (4, 1, None, r"a session of 2 prompt frames starts with frames \(2, 2, 9\), got \(2, 2, 4\)"),
        (9, 2, None, r"chunks between them \(2, 1, 14\), got \(2, 2, 14\); hidden \(2, 1\), got \(2, 2\)"),
        (9, 1, (2, 7), r"a session goes on by chunk \(2, 14\), got \(2, 7\); next chunk .*got \(2, 7\)"),
        (9, 1, (1, 14), r"a session goes on by chunk \(2, 14\), got \(1, 14\)"),
    ],
)
def test_a_session_of_other_shapes_is_refused(tokens, between, chunk, message):
    """Narrower chunks left what stood there of the chunk before, and those of fewer examples moved these alone."""
    config = shallow_config()
    declared, params = lively_params(config)
    chunks, hidden = np.zeros((2, between, TABLE.action_width), np.float32), np.zeros((2, between), bool)

    def begin_and_go_on(params):
        model, robots = declared.merge(params), jnp.zeros(2, jnp.int32)
        session = start(model, jnp.zeros((2, 2, tokens), jnp.int32), chunks, robots, action_hidden_BT=hidden)
        return advance(model, session, jnp.zeros(chunk), jax.random.split(jax.random.key(0), 2), DecodeConfig())

    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(begin_and_go_on, params)


def test_a_session_goes_on_by_no_chunk_that_is_not_finite():
    config = shallow_config()
    declared, params = lively_params(config)

    def go_on(params):
        model, robots = declared.merge(params), jnp.zeros(2, jnp.int32)
        session = start(model, jnp.zeros((2, 1, 9), jnp.int32), jnp.zeros((2, 0, TABLE.action_width)), robots)
        given = np.full((2, TABLE.action_width), np.nan)
        return advance(model, session, given, jax.random.split(jax.random.key(0), 2), DecodeConfig())

    with pytest.raises(ConfigError, match="the actions are not finite"):
        jax.eval_shape(go_on, params)


def test_a_chunk_that_nothing_follows_is_held():
    """With released alignment a frame is shown the chunk after it too, which a simulator does not know."""
    config = model_config(**SMALLER)
    declared, params = lively_params(config, scale=0.5)
    batch, keys = random_batch(0, config, 4), jax.random.split(jax.random.key(0), 4)
    chunk = batch["actions"][:, 0]

    @jax.jit
    def made(params, following):
        model = declared.merge(params)
        session = start(model, batch["tokens"][:, :1], batch["actions"][:, :0], batch["embodiment"])
        decode = DecodeConfig(1, temperature=1.0)
        return advance(model, session, chunk, keys, decode, next_chunk_BU=following, phase="filling")[1]

    held = made(params, chunk)
    np.testing.assert_array_equal(made(params, None), held)
    assert (made(params, 0 * chunk) != held).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": np.zeros((2, 8, 9), np.int32), "actions": np.zeros((2, 8, 14))}, "windows of 2 to 6 frames, got 8"),
        ({"frames": np.zeros((2, 1, 9), np.int32), "actions": np.zeros((2, 1, 14))}, "windows of 2 to 6 frames, got 1"),
        ({"actions": np.zeros((2, 4, 7))}, r"next frames are predicted of chunks \(2, 4, 14\), got \(2, 4, 7\)"),
        ({"robots": np.zeros(1, np.int32)}, r"of robots \(2,\), got \(1,\)"),
        ({"hidden": np.zeros((2, 3), bool)}, r"of hidden \(2, 4\), got \(2, 3\)"),
        ({"frames": np.full((2, 4, 9), 64)}, "got ids from 64 to 64, but the model allows 0 to 63"),
        ({"frames": np.zeros((2, 4, 9))}, "this model's frames are int32, got float64"),
        ({"robots": np.full(2, 99)}, "got robots from 99 to 99, but the model allows 0 to 2"),
        ({"actions": np.full((2, 4, 14), np.nan)}, "the actions are not finite"),
        ({"keys": jax.random.split(jax.random.key(0), 3)}, "2 keys are needed"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_next_frames_are_predicted_of_nothing_that_the_model_does_not_know(changes, message):
    """A window longer than the model's, or an unknown robot, gave predictions that were not finite and ids of 0."""
    declared, params = lively_params(shallow_config())
    given = dict(
        frames=np.zeros((2, 4, 9), np.int32),
        actions=np.zeros((2, 4, 14), np.float32),
        robots=np.zeros(2, np.int32),
        keys=jax.random.split(jax.random.key(0), 2),
        hidden=None,
    )
    *window, keys, hidden = (given | changes).values()
    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(lambda p: next_frames(declared.merge(p), *window, keys, DecodeConfig(), hidden), params)
    if "keys" not in changes:
        with pytest.raises(ConfigError, match=message):
            jax.eval_shape(lambda p: next_frame_outputs(declared.merge(p), *window, hidden), params)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 7}, "actions are predicted in windows of 1 to 6 frames, got 7; cut longer episodes"),
        ({"ids": 64}, "got ids from 64 to 64, but the model allows 0 to 63"),
        ({"robot": 3}, "got robots from 3 to 3, but the model allows 0 to 2"),
        ({"width": 13}, r"actions are predicted of chunks \(1, 6, 14\), got \(1, 6, 13\)"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_actions_are_predicted_in_windows_that_the_model_knows(changes, message):
    """Beyond the window and for unknown robots they were not a number; for unknown ids they were numbers."""
    given = {"frames": 6, "ids": 0, "robot": 0, "width": 14} | changes
    declared, params = lively_params(model_config())
    window = (
        np.full((1, given["frames"], 9), given["ids"], np.int32),
        np.zeros((1, given["frames"], given["width"]), np.float32),
        np.full(1, given["robot"], np.int32),
    )
    hidden, keys = np.zeros((1, given["frames"]), bool), jax.random.split(jax.random.key(0), 1)
    for predict, more in ((predict_actions, (hidden, keys)), (predict_next_actions, (keys,))):
        with pytest.raises(ConfigError, match=message):
            jax.eval_shape(lambda p, f=predict, m=more: f(declared.merge(p), *window, *m, DecodeConfig()), params)
