import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.generation import (
    DecodeConfig,
    masked_counts,
    next_frame_logits,
    rollout,
    rollout_naive,
    unmask,
)
from tests.tiny import TABLE, lively_params, model_config, random_batch


def test_masked_counts_are_the_cosine_schedule_of_the_release():
    assert masked_counts(1, 256) == []
    assert masked_counts(2, 256) == [182]
    assert masked_counts(4, 256) == [237, 182, 98]
    assert masked_counts(8, 256) == [252, 237, 213, 182, 143, 98, 50]


@pytest.mark.parametrize(
    "decode",
    [DecodeConfig(1), DecodeConfig(2), DecodeConfig(3, 1.0), DecodeConfig(4, order="confidence")],
    ids=str,
)
@pytest.mark.parametrize("prompt, alignment", [(1, "released"), (3, "released"), (3, "causal")])
def test_the_cached_rollout_equals_recomputing_the_window(
    decode: DecodeConfig, prompt: int, alignment: str
):
    config = model_config(action_alignment=alignment)
    declared, params = lively_params(config)
    batch = random_batch(0, config, 4)
    other = batch["actions"].copy()
    other[:, prompt - 1 :] = random_batch(1, config, 4)["actions"][:, prompt - 1 :]
    keys = jax.random.split(jax.random.key(0), 4)
    start = batch["tokens"][:, :prompt]

    both = np.stack([batch["actions"], other], axis=1)
    cached = jax.jit(lambda p: rollout(declared.merge(p), start, both, batch["embodiment"], keys, decode))
    naive = jax.jit(
        lambda p, a: rollout_naive(declared.merge(p), start, a, batch["embodiment"], keys, decode)
    )
    got = np.asarray(cached(params))
    np.testing.assert_array_equal(got[:, 0], naive(params, batch["actions"]))
    np.testing.assert_array_equal(got[:, 1], naive(params, other))
    assert (got[:, 0] != got[:, 1]).any()
    assert got.max() < config.vocab_size


def test_equal_actions_give_equal_rollouts_even_when_sampled():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config, 2)
    same = np.stack([batch["actions"]] * 2, axis=1)
    keys = jax.random.split(jax.random.key(0), 2)
    got = rollout(
        declared.merge(params), batch["tokens"][:, :2], same, batch["embodiment"], keys, DecodeConfig(2, 1.0)
    )
    np.testing.assert_array_equal(got[:, 0], got[:, 1])


def test_causal_alignment_conditions_a_frame_on_the_chunk_that_led_to_it():
    def first_frame_to_change(alignment: str, chunk: int) -> int:
        config = model_config(action_alignment=alignment)
        declared, params = lively_params(config)
        hma = declared.merge(params)
        batch = random_batch(0, config, 2)
        actions = batch["actions"].copy()
        actions[:, chunk, :2] += 3.0
        logits = [hma(batch["tokens"], hma.align(a), batch["embodiment"])[0] for a in (batch["actions"], actions)]
        changed = np.abs(logits[0] - logits[1]).max((0, 2, 3, 4)) > 1e-3
        return int(np.argmax(changed))

    assert [first_frame_to_change("released", c) for c in (0, 2)] == [0, 2]
    assert [first_frame_to_change("causal", c) for c in (0, 2)] == [0, 3]


@pytest.mark.parametrize("alignment", ["released", "causal"])
def test_next_frame_logits_equal_one_masked_window_per_frame(alignment: str):
    config = model_config(action_alignment=alignment)
    declared, params = lively_params(config, scale=0.1)
    batch = random_batch(0, config, 3)
    hma = declared.merge(params)
    args = (hma.align(batch["actions"]), batch["embodiment"])
    fast = np.asarray(next_frame_logits(hma, batch["tokens"], batch["actions"], batch["embodiment"]))
    for t in range(1, config.frames):
        window = jnp.asarray(batch["tokens"]).at[:, t:].set(config.mask_id)
        slow = np.asarray(hma(window, *args)[0][:, t])
        np.testing.assert_allclose(fast[:, t - 1], slow, atol=1e-4 * np.abs(slow).max())


def test_known_positions_are_never_drawn_again():
    frame = jnp.array([[7, 99, 99, 99]])
    out = unmask(frame, jnp.array([[1, 2, 3, 4]]), jnp.array([[0.0, 0.1, 0.9, 0.5]]), 1, mask_id=99)
    np.testing.assert_array_equal(out, [[7, 99, 3, 4]])
    out = unmask(out, jnp.array([[5, 6, 7, 8]]), jnp.zeros((1, 4)), 0, mask_id=99)
    np.testing.assert_array_equal(out, [[7, 6, 3, 4]])


def test_temperature_is_a_temperature():
    """Low temperatures approach the most likely token; the release's made no difference."""
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config, 8)
    actions = batch["actions"][:, None]
    keys = jax.random.split(jax.random.key(0), 8)
    run = lambda t: np.asarray(  # noqa: E731
        rollout(declared.merge(params), batch["tokens"][:, :5], actions, batch["embodiment"], keys,
                DecodeConfig(1, t))
    )
    greedy = run(0.0)
    assert (run(0.01) == greedy).mean() > (run(5.0) == greedy).mean() + 0.2


def test_a_rollout_longer_than_the_window_is_refused():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config, 1)
    long = np.zeros((1, 1, config.frames + 1, TABLE.action_width), np.float32)
    with pytest.raises(ConfigError, match="does not fit a window"):
        rollout(declared.merge(params), batch["tokens"][:, :2], long, batch["embodiment"],
                jax.random.split(jax.random.key(0), 1), DecodeConfig())
