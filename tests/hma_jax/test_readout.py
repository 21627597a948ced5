"""Factors that are chained: a distribution over tokens that no product of factors is."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from hma_jax.config import ConfigError
from hma_jax.model.frames import compose
from hma_jax.model.params import declare
from hma_jax.model.readout import ChainedReadout, Readout, choose_likeliest, choose_sampled
from tests.tiny import DIFFUSION, SMALLER, lively_params, model_config

FACTORS, ENTRIES = 3, 4
CONFIG = model_config(**SMALLER | {"factors": FACTORS, "chain_factors": True})
EVERY = jnp.asarray(list(itertools.product(range(ENTRIES), repeat=FACTORS)))
"""Digits of all tokens, [V^Q, Q]."""


def lively_head() -> tuple[nnx.Module, jax.Array]:
    """(head, what it is told of one token [D])."""
    declared, params = lively_params(CONFIG)
    return declared.merge(params).frame_head, jax.random.normal(jax.random.key(1), (CONFIG.width,))


def logits(head: nnx.Module, predictions: jax.Array, digits: jax.Array) -> jax.Array:
    return head.decode_factors(predictions, lambda factor, _: digits[..., factor])[1]


def log_likelihood(head: nnx.Module, predictions: jax.Array, digits: jax.Array) -> jax.Array:
    log_p = jax.nn.log_softmax(logits(head, predictions, digits))
    return jnp.take_along_axis(log_p, digits[..., None], axis=-1)[..., 0].sum(-1)


def of_every_token(head: nnx.Module, predictions: jax.Array) -> np.ndarray:
    """Probabilities [V^Q]."""
    every = jnp.broadcast_to(predictions, (len(EVERY), *predictions.shape))
    return np.exp(np.asarray(jax.jit(lambda: log_likelihood(head, every, EVERY))(), np.float64))


def test_probabilities_of_all_tokens_add_up_to_one_and_are_no_product():
    of = of_every_token(*lively_head())
    assert of.sum() == pytest.approx(1, abs=1e-5)
    table = of.reshape((ENTRIES,) * FACTORS)
    product = np.einsum("a,b,c->abc", table.sum((1, 2)), table.sum((0, 2)), table.sum((0, 1)))
    assert np.abs(table - product).max() > 0.01


def test_a_factor_is_given_those_before_it_and_none_after():
    head, predictions = lively_head()
    asked, zeros = jax.jit(lambda digits: logits(head, predictions, digits)), np.zeros(FACTORS, int)
    before = asked(zeros)
    for changed in range(FACTORS):
        after = asked(np.where(np.arange(FACTORS) == changed, 1, zeros))
        np.testing.assert_array_equal(after[: changed + 1], before[: changed + 1])
        assert (after[changed + 1 :] != before[changed + 1 :]).any(axis=-1).all()


def test_tokens_are_drawn_as_often_as_they_are_likely():
    head, predictions = lively_head()
    draws = 20_000
    told = jnp.broadcast_to(predictions, (draws, *predictions.shape))
    digits, _ = jax.jit(lambda: head.decode_factors(told, choose_sampled(jax.random.key(0), head.shape(told))))()
    share = np.bincount(np.asarray(compose(digits, ENTRIES)), minlength=ENTRIES**FACTORS) / draws
    wanted = of_every_token(head, predictions)
    ids = np.asarray(compose(EVERY, ENTRIES))
    # Five standard errors, of 64 shares.
    assert np.abs(share[ids] - wanted).max() < 5 * np.sqrt(wanted.max() / draws)


def test_each_factor_has_its_own_noise_and_the_top_k_are_the_likeliest():
    even = jnp.zeros((1000, 2, 8))
    choose = choose_sampled(jax.random.key(0), even.shape)
    first, second = (np.asarray(choose(q, even[:, q])) for q in range(2))
    assert np.mean(first == second) == pytest.approx(1 / 8, abs=0.04)
    uneven = jnp.broadcast_to(jnp.log(jnp.array([0.1, 0.4, 0.2, 0.3])), (1000, 1, 4))
    for k, likeliest in ((1, [1]), (2, [1, 3])):
        drawn = choose_sampled(jax.random.key(1), uneven.shape, top_k=k)(0, uneven[:, 0])
        assert np.unique(drawn).tolist() == likeliest


def test_the_likeliest_factor_follows_the_likeliest_before_it():
    head, predictions = lively_head()
    digits, of_each = head.decode_factors(predictions, choose_likeliest)
    np.testing.assert_array_equal(digits, jnp.argmax(logits(head, predictions, digits), axis=-1))
    np.testing.assert_array_equal(of_each, logits(head, predictions, digits))


def test_it_begins_as_if_factors_were_independent():
    declared = declare(lambda: ChainedReadout(CONFIG), 1)
    params = declared.init(0)
    head = declared.merge(params)
    predictions = jax.random.normal(jax.random.key(1), (5, CONFIG.width))
    for digits in (jnp.zeros((5, FACTORS), int), jnp.ones((5, FACTORS), int)):
        np.testing.assert_array_equal(
            *jax.jit(lambda digits=digits: (logits(head, predictions, digits), head.alone(predictions)))()
        )


@pytest.mark.parametrize(("kind", "nats"), [(ChainedReadout, np.log(ENTRIES)), (Readout, FACTORS * np.log(ENTRIES))])
def test_what_stands_in_all_factors_at_once_costs_a_chain_once(kind: type, nats: float):
    """Tokens whose factors are all the same: log V nats, where factors that know nothing of each other cost Q log V."""
    declared = declare(lambda: kind(CONFIG), 1)
    params = declared.init(0)
    x = jnp.zeros((ENTRIES, CONFIG.width))
    same = jnp.broadcast_to(jnp.arange(ENTRIES)[:, None], (ENTRIES, FACTORS))
    adam = optax.adam(3e-2)

    def loss(params) -> jax.Array:
        head = declared.merge(params)
        return -log_likelihood(head, head(x), same).mean()

    def step(carry, _):
        params, state = carry
        value, gradient = jax.value_and_grad(loss)(params)
        updates, state = adam.update(gradient, state)
        return (optax.apply_updates(params, updates), state), value

    losses = jax.jit(lambda params: jax.lax.scan(step, (params, adam.init(params)), length=300)[1])(params)
    assert losses[0] == pytest.approx(FACTORS * np.log(ENTRIES), abs=0.1)
    assert losses[-1] == pytest.approx(nats, abs=0.05)


@pytest.mark.parametrize("changes", [{"factors": 1}, {"diffusion": DIFFUSION}], ids=["one factor", "latents"])
def test_there_must_be_several_factors_to_chain(changes: dict):
    with pytest.raises(
        ConfigError, match="model.chain_factors needs model.factors of at least 2 and model.diffusion=null"
    ):
        model_config(chain_factors=True, **changes)
