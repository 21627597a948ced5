from dataclasses import replace
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import Conditioning, ConfigError, ExecutionConfig, ModelConfig, MupConfig
from hma_jax.evaluation.metrics import factored_cross_entropy
from hma_jax.model.conditioning import IN_BLOCKS, ActionFeature, CrossAttention
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.flops import forward_flops_per_window
from hma_jax.model.frames import compose, factorise
from hma_jax.model.hma import causal_mask, declare_model
from hma_jax.model.params import declare
from tests.tiny import DIFFUSION, TABLE, lively_params, model_config, random_batch, shallow_config


def logits_of(config, declared, params, batch, actions=True):
    given = batch["actions"] if actions else None
    apply = jax.jit(lambda p, b: declared.merge(p)(b["tokens"], None, given, b["embodiment"]).token_outputs)
    return np.asarray(apply(params, batch))


def test_factor_zero_holds_the_low_digits():
    ids = jnp.array([0, 512, 513, 262143])
    factors = factorise(ids, 2, 512)
    np.testing.assert_array_equal(factors, [[0, 0], [0, 1], [1, 1], [511, 511]])
    np.testing.assert_array_equal(compose(factors, 512), ids)


def test_an_untrained_model_s_perplexity_is_the_vocabulary_size():
    config = model_config()
    declared = declare_model(config, TABLE)
    batch = random_batch(0, config)
    logits = logits_of(config, declared, declared.init(0), batch)
    perplexity = np.exp(np.asarray(factored_cross_entropy(logits, batch["tokens"])).mean())
    assert abs(perplexity / config.vocab_size - 1) < 0.02


def test_the_future_does_not_reach_the_past():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config)
    changed = dict(batch, tokens=batch["tokens"].copy(), actions=batch["actions"].copy())
    changed["tokens"][:, 4] = (changed["tokens"][:, 4] + 1) % config.vocab_size
    changed["actions"][:, 4:] += 1
    a = logits_of(config, declared, params, batch)
    b = logits_of(config, declared, params, changed)
    np.testing.assert_array_equal(a[:, :4], b[:, :4])
    assert all(np.abs(a[:, t] - b[:, t]).max() > 1e-3 for t in (4, 5))


def test_the_chunk_before_a_frame_changes_its_logits():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config)
    changed = dict(batch, actions=batch["actions"].copy())
    changed["actions"][:, 2, :2] += 5.0
    a = logits_of(config, declared, params, batch)
    b = logits_of(config, declared, params, changed)
    assert np.abs(a[:, 3] - b[:, 3]).max() > 1e-3


def test_of_actions_attended_to_a_frame_s_own_weighs_as_much_as_all_earlier_ones_until_something_is_learned():
    config = shallow_config(conditioning="cross_attention")
    declared = declare(lambda: CrossAttention(config, 1))
    params = jax.tree.map(lambda x: jnp.zeros(x.shape), declared.shapes())  # of queries and keys: all logits are equal
    params["v"] = params["out"]["kernel"] = jnp.eye(config.width)[None]
    feature = np.random.default_rng(0).normal(size=(2, 6, config.width)).astype(np.float32)
    shown = np.array([[True] * 6, [False, True, False, True, True, False]])
    x, slices = jnp.zeros((2, 6, 3, config.width)), jnp.zeros(2, int)
    attend = jax.jit(declared.merge(params))
    got, cache = attend(x, ActionFeature(feature, shown), slices, causal_mask(6), None)

    def mixed(example, t):
        earlier = [feature[example, s] for s in range(t) if shown[example, s]]
        own = [feature[example, t]] if shown[example, t] else []
        parts = [np.mean(part, axis=0) for part in (earlier, own) if part]
        return np.mean(parts, axis=0) if parts else np.zeros(config.width)

    for example in range(2):
        for t in range(6):
            np.testing.assert_allclose(got[example, t, 1], mixed(example, t), atol=1e-5, err_msg=f"{example}, {t}")
    # with the others in a cache, in any order
    order = np.array([3, 0, 4, 1, 2])
    past = jax.tree.map(lambda a: a[:, order], cache)
    last = ActionFeature(feature[:, 5:], shown[:, 5:])
    again, _ = attend(x[:, 5:], last, slices, jnp.ones((1, 6), bool), past)
    np.testing.assert_allclose(again[:, 0], got[:, 5], atol=1e-5)


def test_actions_are_attended_to_by_the_formula():
    """By hand, in float64, for two robots: queries and keys are normalised, and their products scaled as muP says."""
    config = shallow_config(conditioning="cross_attention", mup=MupConfig(attention_scale=3.0))
    declared, rng, robots = declare(lambda: CrossAttention(config, 2)), np.random.default_rng(0), np.array([1, 0])
    params = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(np.float32), declared.shapes())
    x, a = (rng.normal(size=(2, *shape, config.width)).astype(np.float32) for shape in ((4, 3), (4,)))
    attend = jax.jit(lambda p: declared.merge(p)(x, ActionFeature(a, None), robots, causal_mask(4), None)[0])
    got = attend(params)

    def heads(y, name, robot):
        y = (y.astype(np.float64) @ params[name][robot]).reshape(*y.shape[:-1], config.heads, -1)
        if name == "v":
            return y
        y = (y - y.mean(-1, keepdims=True)) / np.sqrt(y.var(-1, keepdims=True) + 1e-6)
        return y * params["gain"][robot] + params["bias"][robot]

    for example, robot in enumerate(robots):
        q, k, v = (heads(y[example], name, robot) for y, name in ((x, "q"), (a, "k"), (a, "v")))
        for t in range(4):
            logits = 3 / config.head_width * np.einsum("phi,shi->phs", q[t], k[: t + 1])
            logits[..., t] += np.log(max(t, 1))  # as much as all earlier ones
            weights = np.exp(logits - logits.max(-1, keepdims=True))
            weights /= weights.sum(-1, keepdims=True)
            y = np.einsum("phs,shi->phi", weights, v[: t + 1]).reshape(3, -1)
            want = y @ params["out"]["kernel"][robot] + params["out"]["bias"][robot]
            np.testing.assert_allclose(got[example, t], want, rtol=1e-3, atol=1e-3)


def test_every_way_of_conditioning_in_blocks_is_a_class_of_its_own():
    """Not that of another one whose name it contains."""
    ways = {ModelConfig(conditioning=kind).block_conditioning for kind in get_args(Conditioning)}
    assert ways - {None} == set(IN_BLOCKS), "add yours to IN_BLOCKS of hma_jax/model/conditioning.py"
    assert len(set(IN_BLOCKS.values())) == len(IN_BLOCKS)


def test_padding_and_dead_dimensions_of_actions_are_ignored():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config)
    batch["embodiment"][:] = 2  # its second dimension never moves; chunk 9 of 14
    noisy = dict(batch, actions=batch["actions"].copy())
    noisy["actions"][:, :, [1, 4, 7]] += 3.0
    noisy["actions"][:, :, 9:] = 7.0
    np.testing.assert_array_equal(
        logits_of(config, declared, params, batch), logits_of(config, declared, params, noisy)
    )


def test_an_example_does_not_depend_on_the_robots_beside_it():
    config = model_config()
    declared, params = lively_params(config)
    batch = random_batch(0, config)
    alone = {k: v[:1] for k, v in batch.items()}
    together = logits_of(config, declared, params, batch)[:1]
    np.testing.assert_allclose(together, logits_of(config, declared, params, alone), atol=2e-4)


def test_bfloat16_changes_logits_little_and_they_stay_float32():
    config = model_config()
    declared, params = lively_params(config, scale=0.05)
    batch = random_batch(0, config)
    a = logits_of(config, declared, params, batch)
    b = logits_of(config, declare_model(config, TABLE, ExecutionConfig("bfloat16")), params, batch)
    assert b.dtype == np.float32
    np.testing.assert_allclose(a, b, atol=0.1 * np.abs(a).max())


def test_flops_grow_with_the_square_of_the_width():
    base = forward_flops_per_window(ModelConfig(width=256), TABLE)
    wide = forward_flops_per_window(ModelConfig(width=512), TABLE)
    assert 3.4 < wide / base < 4.0


def test_flops_formula_counts_what_the_program_multiplies():
    """Against XLA's count of one unscanned, unmodulated block without attention scores."""
    config = model_config(layers=1, frames=4, tokens=64, action_tokens=1, width=64)
    table = EmbodimentTable((Embodiment("a", 2, 1, (0.0,) * 2, (1.0,) * 2),))
    declared = declare_model(config, table)
    batch = random_batch(0, config, 1, table)
    apply = jax.jit(
        lambda p: declared.merge(p)(batch["tokens"], None, batch["actions"], batch["embodiment"]).token_outputs
    )
    counted = apply.lower(declared.init(0)).compile().cost_analysis()["flops"]
    formula = forward_flops_per_window(config, table)
    # XLA adds element-wise work and full (not causal) temporal scores.
    assert 0.75 < formula / counted < 1.05


def test_heads_must_divide_the_width():
    with pytest.raises(ConfigError, match="not a multiple of model.heads"):
        ModelConfig(width=250)


def test_mup_scales_attention_with_the_head_and_the_readout_with_the_width():
    config = model_config(width=64, mup=MupConfig(base_width=32))
    declared, params = lively_params(config)
    hma = declared.merge(params)
    assert hma.trunk.blocks.space.scale == 8.0 / 16
    x = jnp.ones((1, 64))
    linear = params["frame_head"]["linear"]
    plain = x @ linear["kernel"] / 2 + linear["bias"]
    np.testing.assert_allclose(hma.frame_head(x).reshape(1, -1), plain, rtol=1e-5)


@pytest.mark.parametrize("changes", [{"chain_factors": True}, {"diffusion": DIFFUSION}], ids=["ids", "latents"])
def test_every_head_reads_of_a_wider_trunk_as_much_less_as_it_is_wider(changes):
    """What the same matrices, times m, read without this part of muP."""
    mup = MupConfig(base_width=32)
    config = model_config(width=64, mup=mup, **changes)
    declared, params = lively_params(config, scale=0.05)
    wider = jax.tree.map(lambda x, spec: 2 * x if spec.role == "output" else x, params, declared.specs)
    batch, z = random_batch(0, config, 2), jax.random.normal(jax.random.key(0), (2, 6, 9, 64))
    tokens, actions, robots = batch["tokens"], batch["actions"], batch["embodiment"]

    def read(config, params):
        hma = declare_model(config, TABLE).merge(params)
        if config.diffusion is None:
            return hma.logits(z, tokens), hma.action_head(z[:, :, 0], robots)
        time = jnp.full(tokens.shape[:3], 5)
        return hma.denoiser(tokens, time, z), hma.action_head(actions, time[:, :, 0], z[:, :, 0], robots)

    divided, whole = (
        jax.jit(partial(read, c)) for c in (config, replace(config, mup=replace(mup, without=("readout",))))
    )
    for a, b, without in zip(divided(wider), whole(params), whole(wider), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
        assert not np.allclose(a, without, rtol=1e-2, atol=1e-2)
