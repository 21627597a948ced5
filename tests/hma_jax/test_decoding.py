"""How one frame is filled: how many tokens stay masked, which are drawn, and what tokens do not allow."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, EvalConfig, SamplerConfig
from hma_jax.generation import decoding
from hma_jax.generation.decoding import Frame, masked_counts, sample_tokens, unmask
from hma_jax.simulator.folder import DEFAULT_DECODE, change_decode, find_decode
from tests.tiny import DIFFUSION, model_config


def test_masked_counts_are_the_cosine_schedule_of_the_release():
    discrete = model_config(tokens=256)
    assert masked_counts(discrete, 1) == [0]
    assert masked_counts(discrete, 2) == [182, 0]
    assert masked_counts(discrete, 4) == [237, 182, 98, 0]
    assert masked_counts(discrete, 8) == [252, 237, 213, 182, 143, 98, 50, 0]
    continuous = model_config(tokens=256, diffusion=DIFFUSION)
    assert masked_counts(continuous, 4) == [236, 181, 97, 0]


def test_where_half_of_a_frame_stays_masked_the_last_bit_is_the_release_s():
    """cos(pi/2 2/3) comes out a little above or below 1/2, by the order of its products: one token more or less."""
    discrete = model_config(tokens=256)
    assert [masked_counts(discrete, steps)[2 * steps // 3 - 1] for steps in (3, 39, 51)] == [129, 129, 129]
    continuous = model_config(tokens=256, diffusion=DIFFUSION)
    assert [masked_counts(continuous, steps)[2 * steps // 3 - 1] for steps in (3, 39, 51)] == [128, 127, 127]


def test_known_positions_are_never_drawn_again():
    frame = Frame(jnp.array([[7, 0, 0, 0]]), jnp.array([[False, True, True, True]]))
    out = unmask(frame, jnp.array([[1, 2, 3, 4]]), jnp.array([[0.0, 0.1, 0.9, 0.5]]), 1)
    np.testing.assert_array_equal(out.values, [[7, 0, 3, 4]])
    np.testing.assert_array_equal(out.masked, [[False, True, False, False]])
    out = unmask(out, jnp.array([[5, 6, 7, 8]]), jnp.zeros((1, 4)), 0)
    np.testing.assert_array_equal(out.values, [[7, 6, 3, 4]])


@pytest.mark.parametrize("tokens", [1, 4])
def test_more_looks_than_tokens_draw_each_token_of_a_continuous_frame_once(monkeypatch, tokens: int):
    """Of nine looks at so few tokens some unmask none, and the denoiser has nothing to draw."""
    drawn, config = [], model_config(tokens=tokens, diffusion=DIFFUSION)

    def numbered(model, z, keys, decode):
        drawn.append(z.shape[1])
        return jnp.full((*z.shape[:2], DIFFUSION.token_channels), float(len(drawn)))

    monkeypatch.setattr(decoding, "denoise", numbered)
    predictions, keys = jnp.zeros((2, tokens, 3)), jax.random.split(jax.random.key(0), 2)
    decode = DecodeConfig(9, sampler=SamplerConfig(steps=3))
    model = SimpleNamespace(config=config)
    fill = jax.jit(lambda keys: decoding.decode_frame(model, predictions, lambda _: predictions, keys, decode))
    frame = np.asarray(fill(keys))
    assert min(drawn) == 1 and sum(drawn) == tokens
    np.testing.assert_array_equal(np.sort(frame[..., 0]), [np.repeat(np.arange(1.0, len(drawn) + 1), drawn)] * 2)


@pytest.mark.parametrize(("resample", "sizes"), [(False, [2, 2]), (True, [2, 4])])
def test_every_look_samples_all_that_is_no_longer_masked_where_that_is_asked_for(monkeypatch, resample, sizes):
    drawn, config = [], model_config(tokens=4, diffusion=DIFFUSION)
    monkeypatch.setattr(
        decoding,
        "denoise",
        lambda model, z, *_: drawn.append(z.shape[1]) or jnp.zeros((*z.shape[:2], config.frame_shape[1])),
    )
    predictions, keys = jnp.zeros((1, 4, 3)), jax.random.split(jax.random.key(0), 1)
    decode = DecodeConfig(2, sampler=SamplerConfig(steps=3), resample=resample)
    model = SimpleNamespace(config=config)
    jax.eval_shape(lambda keys: decoding.decode_frame(model, predictions, lambda _: predictions, keys, decode), keys)
    assert drawn == sizes


def test_the_surest_tokens_are_drawn_first_or_any_by_the_order_that_is_asked_for(monkeypatch):
    """Of four tokens the first of two looks leaves three masked; ids say which look drew them."""
    config, rows = model_config(tokens=4), 8
    confidence = jnp.tile(jnp.array([0.1, 0.4, 0.2, 0.3]), (rows, 1))
    monkeypatch.setattr(decoding, "sample_tokens", lambda head, look, *_: (look, confidence))
    model, look = SimpleNamespace(config=config, frame_head=None), jnp.ones((rows, 4), jnp.int32)

    @jax.jit
    def draw(keys):
        decodes = [DecodeConfig(2, order=order) for order in ("confidence", "random")]
        return [decoding.decode_frame(model, look, lambda _: look + 1, keys, decode) for decode in decodes]

    surest, other = draw(jax.random.split(jax.random.key(0), rows))
    np.testing.assert_array_equal(surest, np.tile([2, 1, 2, 2], (rows, 1)))
    assert ((other == 1).sum(1) == 1).all() and len(np.unique(other, axis=0)) > 1


def test_the_order_is_drawn_apart_from_what_is_drawn(monkeypatch):
    """Else the values of the tokens that are drawn first would be others than those of the rest."""
    rows, size, given = 8, 16, []
    monkeypatch.setattr(
        decoding, "sample_tokens", lambda head, look, keys, *_: given.append(keys) or (look, jnp.zeros((rows, size)))
    )
    model, look = SimpleNamespace(config=model_config(tokens=size), frame_head=None), jnp.ones((rows, size), jnp.int32)
    keys = jax.random.split(jax.random.key(0), rows)
    first = np.asarray(decoding.decode_frame(model, look, lambda _: look + 1, keys, DecodeConfig(2))) == 1
    scores = jax.vmap(lambda key: jax.random.uniform(key, (size,)))(given[0])
    of_the_same_key = np.argsort(np.argsort(scores, axis=1), axis=1) >= size - 4
    assert (first.sum(1) == 4).all() and (first != of_the_same_key).any(1).all()


def test_latents_are_kept_within_the_clip_of_the_configuration():
    """Of a network that takes all that it sees for noiseless."""
    config = model_config(tokens=4, diffusion=replace(DIFFUSION, clip=0.1))
    shape = (2, 4, 2 * config.diffusion.token_channels)
    model = SimpleNamespace(config=config, denoiser=lambda x, t, z: jnp.zeros(shape))
    keys, decode = jax.random.split(jax.random.key(0), 2), DecodeConfig(sampler=SamplerConfig(steps=3))
    made = jax.jit(lambda z: decoding.denoise(model, z, keys, decode))(jnp.zeros((2, 4, 3)))
    assert np.abs(made).max() == np.float32(0.1)


def test_every_look_draws_with_random_numbers_of_its_own(monkeypatch):
    """Each fills some of 16 tokens, here with a part of the key that it is given."""

    def sample(head, predictions, keys, *_):
        part = jax.random.key_data(keys)[:, -1:].astype(jnp.int32)
        return jnp.broadcast_to(part, (1, 16)), jnp.zeros((1, 16))

    monkeypatch.setattr(decoding, "sample_tokens", sample)
    model, predictions = SimpleNamespace(config=model_config(tokens=16), frame_head=None), np.zeros((1, 16, 2))
    fill = jax.jit(lambda key: decoding.decode_frame(model, predictions, lambda _: predictions, key, DecodeConfig(3)))
    assert len(np.unique(fill(jax.random.split(jax.random.key(0), 1)))) == 3


def test_the_confidence_in_a_token_is_the_product_of_its_factors_probabilities():
    logits = jnp.log(jnp.array([[[[0.9, 0.1], [0.4, 0.6]], [[0.2, 0.8], [0.5, 0.5]]]]))  # of two tokens, two factors
    head = SimpleNamespace(shape=lambda x: x.shape, decode_factors=lambda x, choose: (choose(0, x), x))
    ids, confidence = sample_tokens(head, logits, jax.random.split(jax.random.key(0), 1), temperature=0)
    assert ids.tolist() == [[2, 1]]
    np.testing.assert_allclose(confidence, [[0.9 * 0.6, 0.8 * 0.5]], rtol=1e-6)


@pytest.mark.parametrize(
    ("diffusion", "decode", "message"),
    [
        (None, DecodeConfig(top_k=9), "decode.top_k 9 exceeds the 8 entries"),
        (DIFFUSION, DecodeConfig(order="confidence"), "'confidence' needs probabilities"),
        (None, DecodeConfig(resample=True), "resample works only for models on latents"),
        (DIFFUSION, replace(DecodeConfig(), temperature=0.7), "latents are drawn at decode.sampler.temperature, which"),
        (DIFFUSION, DecodeConfig(top_k=3), "top_k works only for models on ids"),
        (
            DIFFUSION,
            DecodeConfig(sampler=SamplerConfig(steps=21)),
            "sampler.steps 21 is more than model.diffusion.steps 20",
        ),
    ],
)
def test_frames_are_not_filled_in_ways_that_their_tokens_do_not_have(diffusion, decode: DecodeConfig, message: str):
    model = SimpleNamespace(config=model_config(diffusion=diffusion))
    with pytest.raises(ConfigError, match=message):
        decoding.decode_frame(
            model, jnp.zeros((1, 9, 3)), lambda _: None, jax.random.split(jax.random.key(0), 1), decode
        )


def test_a_temperature_is_that_of_token_ids_and_of_latents():
    """Asked for greedy frames, models on latents sampled theirs."""
    warm = change_decode(DEFAULT_DECODE, 0.7, unmask_steps=5, slide=None)
    latents = replace(DEFAULT_DECODE.sampler, temperature=0.7)
    assert warm == replace(DEFAULT_DECODE, unmask_steps=5, temperature=0.7, sampler=latents)
    assert change_decode(DEFAULT_DECODE) == DEFAULT_DECODE
    for temperature in (0.0, 0.7):
        assert DecodeConfig(temperature=temperature).sampler == SamplerConfig(temperature=temperature)


def test_without_a_file_frames_are_decoded_greedily_as_they_are_judged(tmp_path):
    """Ids were, but latents were sampled."""
    found = find_decode(tmp_path)
    assert found == change_decode(found, 0.0)
    assert found.sampler.temperature == EvalConfig().decode.sampler.temperature
