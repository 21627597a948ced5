from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import DecodeConfig, SamplerConfig
from hma_jax.generation import (
    advance,
    next_frame_outputs,
    next_frames,
    rollout,
    rollout_naive,
    start,
)
from hma_jax.generation.decoding import decode_frame
from hma_jax.generation.rollout import Sequences
from tests.tiny import DIFFUSION, SMALLER, TABLE, lively_params, model_config, random_batch, shallow_config

SAMPLER = SamplerConfig(steps=5)
LATER = (pytest.mark.exact, pytest.mark.slow)


def some(cases: list) -> list:
    """Those that only `make test-slow` runs."""
    return [pytest.param(case, marks=pytest.mark.slow) for case in cases]


def jitted_rollout(declared, batch, actions, keys, decode, prompt, **options):
    """params -> frames of one rollout of `batch` from `prompt` frames."""
    return jax.jit(
        lambda p: rollout(
            declared.merge(p), batch["tokens"][:, :prompt], actions, batch["embodiment"], keys, decode, **options
        )
    )


def rolled_out(config, decode: DecodeConfig, prompt: int, hidden=None, frames: int | None = None):
    """(frames under two sequences of actions, by one rollout with its cache; the same without it, under the k-th)."""
    declared, params = lively_params(config, scale=0.05 if config.diffusion else 0.2)
    longer = replace(config, frames=frames or config.frames)
    batch = random_batch(0, longer, 4)
    other = batch["actions"].copy()
    other[:, prompt - 1 :] = random_batch(1, longer, 4)["actions"][:, prompt - 1 :]
    keys = jax.random.split(jax.random.key(0), 4)
    start = batch["tokens"][:, :prompt]

    both = np.stack([batch["actions"], other], axis=1)
    args = (batch["embodiment"], keys, decode)
    cached = jax.jit(lambda p: rollout(declared.merge(p), start, both, *args, action_hidden_BT=hidden))
    naive = jax.jit(lambda p, a: rollout_naive(declared.merge(p), start, a, *args, action_hidden_BT=hidden))
    return np.asarray(cached(params)), lambda k: naive(params, both[:, k])


def compare_with_naive(config, decode: DecodeConfig, prompt: int, hidden=None, frames: int | None = None):
    got, naive = rolled_out(config, decode, prompt, hidden, frames)
    for index in range(2):
        want = naive(index)
        if config.diffusion:
            np.testing.assert_allclose(got[:, index], want, atol=2e-3)
        else:
            np.testing.assert_array_equal(got[:, index], want)
    return got


@pytest.mark.exact
@pytest.mark.parametrize(
    "decode, prompt, alignment",
    [
        pytest.param(DecodeConfig(1), 1, "released", marks=pytest.mark.slow),
        pytest.param(DecodeConfig(2), 3, "released", marks=pytest.mark.slow),
        pytest.param(DecodeConfig(3, 1.0), 3, "causal", marks=pytest.mark.slow),
        pytest.param(DecodeConfig(4, order="confidence"), 1, "causal", marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_cached_rollout_equals_recomputing_the_window(decode: DecodeConfig, prompt: int, alignment: str):
    config = model_config(action_alignment=alignment)
    got = compare_with_naive(config, decode, prompt)
    assert (got[:, 0] != got[:, 1]).any()
    assert got.max() < config.vocab_size


def test_the_cached_rollout_is_exact_with_everything_that_the_release_lacks_at_once():
    """Past the window, and drawn with the same random numbers. That each counts is said below, by `make test-slow`."""
    config = shallow_config(conditioning="cross_attention", recall=True, chain_factors=True, frames=4)
    decode = DecodeConfig(2, temperature=1.0)
    got = compare_with_naive(config, decode, 2, frames=6)
    assert (got[:, 0] != got[:, 1]).any()


@pytest.mark.slow
@pytest.mark.parametrize("conditioning", ["cross_attention", "modulate", "concat", "add"])
def test_the_cached_rollout_is_exact_under_every_conditioning(conditioning: str):
    got = compare_with_naive(model_config(conditioning=conditioning), DecodeConfig(2), 2)
    assert (got[:, 0] != got[:, 1]).any()


@pytest.mark.slow
@pytest.mark.parametrize("diffusion", [None, DIFFUSION], ids=["ids", "latents"])
def test_the_cached_rollout_is_exact_where_masked_tokens_recall_the_frame_before(diffusion):
    """Past the window too; and what is recalled counts."""
    config = shallow_config(recall=True, diffusion=diffusion, frames=4)
    decode = DecodeConfig(2, sampler=SAMPLER)
    got = compare_with_naive(config, decode, 2, frames=6)
    forgetful = compare_with_naive(replace(config, recall=False), decode, 2, frames=6)
    assert (got != forgetful).any()


@pytest.mark.slow
def test_the_cached_rollout_is_exact_where_factors_are_chained():
    """Drawn, not the likeliest: with the same random numbers. And what is chosen of a factor counts for the next."""
    config = shallow_config(chain_factors=True, frames=4)
    decode = DecodeConfig(2, temperature=1.0)
    got = compare_with_naive(config, decode, 2, frames=6)
    independent = compare_with_naive(replace(config, chain_factors=False), decode, 2, frames=6)
    assert (got != independent).any()


@pytest.mark.exact
@pytest.mark.parametrize("resample", some([False, True]))
def test_the_cached_rollout_is_exact_for_continuous_tokens(resample: bool):
    config = model_config(diffusion=DIFFUSION)
    got = compare_with_naive(config, DecodeConfig(2, sampler=SAMPLER, resample=resample), 2)
    assert np.abs(got[:, 0] - got[:, 1]).max() > 1e-2


@pytest.mark.exact
@pytest.mark.parametrize("conditioning", some(["concat+modulate", "cross_attention"]))
def test_the_cached_rollout_is_exact_with_hidden_actions(conditioning: str):
    hidden = np.random.default_rng(0).random((4, 6)) < 0.5
    compare_with_naive(model_config(conditioning=conditioning), DecodeConfig(2), 3, hidden)


@pytest.mark.exact
@pytest.mark.parametrize("conditioning", some(["cross_attention", "concat+modulate"]))
def test_actions_that_are_all_hidden_make_no_difference(conditioning: str):
    config = model_config(conditioning=conditioning)
    declared, params = lively_params(config)
    batch = random_batch(0, config, 2)
    actions = np.stack([batch["actions"], batch["actions"] + 3], axis=1)
    keys = jax.random.split(jax.random.key(0), 2)
    hidden = np.ones((2, 6), bool)
    blind = jitted_rollout(declared, batch, actions, keys, DecodeConfig(2), 2, action_hidden_BT=hidden)(params)
    np.testing.assert_array_equal(blind[:, 0], blind[:, 1])


@pytest.mark.slow
def test_top_1_is_greedy():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config, 2)
    keys = jax.random.split(jax.random.key(0), 2)
    actions = batch["actions"][:, None]
    greedy, top = DecodeConfig(2), DecodeConfig(2, 1.0, top_k=1)
    a, b = (jitted_rollout(declared, batch, actions, keys, d, 2)(params) for d in (greedy, top))
    np.testing.assert_array_equal(a, b)


def test_every_frame_of_every_example_is_drawn_with_random_numbers_of_its_own():
    sequences = Sequences(None, None, None, jax.random.split(jax.random.key(0), 2))
    keys = [jax.random.key_data(sequences.keys_at(t)).tolist() for t in (1, 2)]
    assert len({tuple(key) for at in keys for key in at}) == 4


def test_causal_alignment_conditions_a_frame_on_the_chunk_that_led_to_it():
    def first_frame_to_change(alignment: str, chunk: int) -> int:
        config = model_config(action_alignment=alignment)
        declared, params = lively_params(config)
        hma = declared.merge(params)
        batch = random_batch(0, config, 2)
        actions = batch["actions"].copy()
        actions[:, chunk, :2] += 3.0
        hidden = hma.align_hidden(None, (2, config.frames))
        look = jax.jit(
            lambda a: (
                hma(batch["tokens"], None, hma.align(a), batch["embodiment"], action_hidden_BT=hidden).token_outputs
            )
        )
        logits = [look(a) for a in (batch["actions"], actions)]
        changed = np.abs(logits[0] - logits[1]).max((0, 2, 3, 4)) > 1e-3
        return int(np.argmax(changed))

    assert [first_frame_to_change("released", c) for c in (0, 2)] == [0, 2]
    assert [first_frame_to_change("causal", c) for c in (0, 2)] == [1, 3]


@pytest.mark.parametrize("alignment", ["released", "causal"])
def test_next_frame_outputs_equal_one_masked_window_per_frame(alignment: str):
    config = model_config(action_alignment=alignment)
    declared, params = lively_params(config, scale=0.1)
    batch = random_batch(0, config, 3)
    hma = declared.merge(params)
    hidden = hma.align_hidden(None, batch["tokens"].shape[:2])
    look = jax.jit(
        lambda masked: (
            hma(
                batch["tokens"], masked, hma.align(batch["actions"]), batch["embodiment"], action_hidden_BT=hidden
            ).token_outputs
        )
    )
    fast = jax.jit(lambda: next_frame_outputs(hma, batch["tokens"], batch["actions"], batch["embodiment"]))()
    for t in range(1, config.frames):
        masked = np.broadcast_to(np.arange(config.frames)[None, :, None] >= t, batch["tokens"].shape)
        slow = np.asarray(look(masked)[:, t])
        np.testing.assert_allclose(fast[:, t - 1], slow, atol=1e-4 * np.abs(slow).max())


@pytest.mark.parametrize(
    "options, decode",
    [
        pytest.param(SMALLER | {"recall": True}, DecodeConfig(2, 1.0), id="smallest"),
        pytest.param({"conditioning": "concat+modulate"}, DecodeConfig(3, 1.0), id="sampled", marks=LATER),
        pytest.param({"action_alignment": "causal"}, DecodeConfig(2, order="confidence"), id="causal", marks=LATER),
        pytest.param({"diffusion": DIFFUSION}, DecodeConfig(2, sampler=SAMPLER), id="continuous", marks=LATER),
        pytest.param({"conditioning": "cross_attention"}, DecodeConfig(2), id="cross-attention", marks=LATER),
    ],
)
def test_next_frames_equal_one_rollout_of_a_frame_per_recorded_past(options: dict, decode: DecodeConfig):
    """Of one example whose actions are hidden, and of others."""
    config = model_config(**options)
    declared, params = lively_params(config, scale=0.05 if config.diffusion else 0.2)
    batch, keys = random_batch(0, config, 3), jax.random.split(jax.random.key(0), 3)
    tokens, actions, rest = batch["tokens"], batch["actions"], (batch["embodiment"], keys, decode)
    hidden = np.repeat([[True], [False], [False]], config.frames, axis=1)
    fast = jax.jit(lambda p: next_frames(declared.merge(p), tokens, actions, *rest, hidden)[1])(params)
    for t in range(1, config.frames):
        given = tokens[:, :t], actions[:, : t + 1], *rest
        shown = hidden[:, : t + 1]
        slow = jax.jit(lambda p, g=given, h=shown: rollout_naive(declared.merge(p), *g, action_hidden_BT=h)[:, 0])(
            params
        )
        if config.diffusion:
            np.testing.assert_allclose(fast[:, t - 1], slow, atol=2e-3)
        else:
            np.testing.assert_array_equal(fast[:, t - 1], slow)


def test_temperature_is_a_temperature():
    """Low temperatures approach the most likely token; the release's made no difference."""
    config = shallow_config()
    declared, params = lively_params(config)
    shape = (8, config.tokens, config.factors, config.factor_vocab)
    logits = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    keys = jax.random.split(jax.random.key(0), 8)

    def run(temperature: float) -> np.ndarray:
        decode = DecodeConfig(1, temperature)
        drawn = jax.jit(lambda p: decode_frame(declared.merge(p), logits, lambda _: logits, keys, decode))
        return np.asarray(drawn(params))

    greedy = run(0.0)
    assert (run(0.01) == greedy).mean() > (run(5.0) == greedy).mean() + 0.2


LONG = 14  # frames, of models whose window has 6


def long_batch(config, frames: int = LONG) -> dict:
    return random_batch(0, replace(config, frames=frames), 2)


def past_the_window(config, decode: DecodeConfig, prompt: int, hidden=None, frames: int = LONG):
    """(params, params -> (`rollout`'s frames, `rollout_naive`'s))."""
    declared, params = lively_params(config, scale=0.05 if config.diffusion else 0.2)
    batch, keys = long_batch(config, frames), jax.random.split(jax.random.key(0), 2)
    start, rest = batch["tokens"][:, :prompt], (batch["embodiment"], keys, decode)
    fast = jax.jit(
        lambda p: rollout(declared.merge(p), start, batch["actions"][:, None], *rest, action_hidden_BT=hidden)
    )
    naive = jax.jit(lambda p: rollout_naive(declared.merge(p), start, batch["actions"], *rest, action_hidden_BT=hidden))
    return params, lambda p: (np.asarray(fast(p))[:, 0], np.asarray(naive(p)))


def whole_rollouts(config, decode: DecodeConfig, prompt: int, hidden=None) -> tuple[np.ndarray, np.ndarray]:
    """Past the window: (`rollout`'s frames, `rollout_naive`'s)."""
    params, both = past_the_window(config, decode, prompt, hidden)
    return both(params)


@pytest.mark.exact
@pytest.mark.parametrize(
    "options, decode, prompt",
    [
        pytest.param({}, DecodeConfig(2), 2, marks=pytest.mark.slow),
        pytest.param({"action_alignment": "causal"}, DecodeConfig(3, 1.0), 5, marks=pytest.mark.slow),
        pytest.param({"conditioning": "cross_attention"}, DecodeConfig(1), 9, marks=pytest.mark.slow),
        pytest.param(
            {"conditioning": "modulate", "action_alignment": "causal"},
            DecodeConfig(2, order="confidence"),
            6,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["released", "sampled-causal", "long-prompt", "full-window"],
)
def test_the_sliding_rollout_equals_recomputing_every_window(options: dict, decode: DecodeConfig, prompt: int):
    got, want = whole_rollouts(model_config(**options), decode, prompt)
    assert got.shape[1] == LONG - prompt
    np.testing.assert_array_equal(got, want)


NEW, FEWER = 24, 6
"""Frames, many of them past a window of 4. What recomputes them is written out frame by frame, and compiled so."""
GREEDY, SAMPLED = DecodeConfig(2), DecodeConfig(2, 1.0, top_k=4)


def case(conditioning: str, decode: DecodeConfig, alignment: str = "released", most: int = NEW):
    name = f"{conditioning}-{'sampled' if decode.temperature else 'greedy'}-{alignment}-{most}"
    marks = [pytest.mark.slow, pytest.mark.exact] if most == NEW else []  # as users compile, by `make test-slow`
    return pytest.param(conditioning, decode, alignment, most, marks=marks, id=name)


@pytest.mark.parametrize(
    "conditioning, decode, alignment, most",
    [
        case("concat+modulate", SAMPLED, "causal", FEWER),
        case("concat+modulate", SAMPLED, "causal"),
        case("concat+modulate", SAMPLED),
        case("concat+modulate", GREEDY),
        *(case(name, how) for name in ("modulate", "concat", "add", "cross_attention") for how in (GREEDY, SAMPLED)),
    ],
)
def test_any_number_of_frames_of_different_robots_equals_the_oracle_s(
    conditioning: str, decode: DecodeConfig, alignment: str, most: int
):
    config = model_config(conditioning=conditioning, frames=4, action_alignment=alignment)
    declared, params = lively_params(config)
    batch = random_batch(0, model_config(frames=1 + most), TABLE.size)
    robots, keys = np.arange(TABLE.size), jax.random.split(jax.random.key(0), TABLE.size)
    start, actions = batch["tokens"][:, :1], batch["actions"]
    naive = jax.jit(lambda p: rollout_naive(declared.merge(p), start, actions, robots, keys, decode))
    want = np.asarray(naive(params))
    for new in (1, most) if decode == SAMPLED and alignment == "released" else (most,):
        chunks = actions[:, None, : 1 + new]
        fast = jax.jit(lambda p, a=chunks: rollout(declared.merge(p), start, a, robots, keys, decode)[:, 0])
        np.testing.assert_array_equal(fast(params), want[:, :new])


@pytest.mark.slow
def test_the_sliding_rollout_is_exact_for_continuous_tokens_and_hidden_actions():
    hidden = np.random.default_rng(0).random((2, LONG)) < 0.5
    got, want = whole_rollouts(model_config(diffusion=DIFFUSION), DecodeConfig(2, sampler=SAMPLER), 4, hidden)
    np.testing.assert_allclose(got, want, atol=2e-3)


def test_streaming_is_exact_but_for_what_a_finished_frame_had_seen_and_where_it_stood():
    """In one layer its keys and values are those of itself and its position: without positions they never change."""
    config, prompt, frames = shallow_config(frames=4), 2, 8
    hidden = np.random.default_rng(0).random((2, frames)) < 0.5
    params, both = past_the_window(config, DecodeConfig(2, slide="streaming"), prompt, hidden, frames)
    streamed, exact = both(params)
    inside = config.frames - prompt
    np.testing.assert_array_equal(streamed[:, :inside], exact[:, :inside])
    assert (streamed[:, inside:] != exact[:, inside:]).any()
    anywhere = {name: jnp.zeros_like(params[name]) for name in ("positions", "action_mask")}
    streamed, exact = both(params | anywhere)
    np.testing.assert_array_equal(streamed, exact)


@pytest.mark.parametrize(
    "changes, decode, prompt",
    [
        pytest.param(SMALLER | {"frames": 5}, DecodeConfig(1, 1.0, slide="streaming"), 6, id="smallest"),
        # In every run tests/hma_jax/simulator compares episodes, frame by frame, with rollouts.
        pytest.param({"action_alignment": "causal"}, DecodeConfig(2), 3, id="exact", marks=LATER),
        pytest.param(
            {"action_alignment": "causal"}, DecodeConfig(2, slide="streaming"), 2, id="streaming", marks=LATER
        ),
        pytest.param({}, DecodeConfig(2, 1.0), 8, id="long-prompt", marks=LATER),
    ],
)
def test_a_session_makes_the_frames_of_a_rollout_one_by_one(changes, decode: DecodeConfig, prompt: int):
    """Of one episode whose actions are hidden and of one whose are shown."""
    config = model_config(**changes)
    declared, params = lively_params(config, scale=0.5)
    batch, keys = long_batch(config), jax.random.split(jax.random.key(0), 2)
    actions, tokens, robots = jnp.asarray(batch["actions"]), batch["tokens"][:, :prompt], batch["embodiment"]
    action_hidden_B = jnp.array([True, False])
    hidden = jnp.repeat(action_hidden_B[:, None], LONG, axis=1)
    whole = jitted_rollout(declared, batch, actions[:, None], keys, decode, prompt, action_hidden_BT=hidden)(params)[
        :, 0
    ]

    @jax.jit
    def begin(params):
        between, unseen = actions[:, : prompt - 1], hidden[:, : prompt - 1]
        return start(declared.merge(params), tokens, between, robots, action_hidden_BT=unseen)

    @partial(jax.jit, donate_argnums=1)
    def step(params, session, chunk, following):
        rest = dict(next_chunk_BU=following, action_hidden_B=action_hidden_B)
        return advance(declared.merge(params), session, chunk, keys, decode, **rest)

    session, frames = begin(params), []
    for t in range(prompt, LONG):
        session, frame = step(params, session, actions[:, t - 1], actions[:, t])
        frames.append(frame)
    np.testing.assert_array_equal(np.stack(frames, axis=1), whole)
    assert step._cache_size() == 1, "a step was compiled more than once"
