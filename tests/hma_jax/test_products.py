"""Counting a program's matrix products."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ExecutionConfig, MaskingConfig
from hma_jax.diagnostics.products import Product, count_products, total_flops
from hma_jax.model.flops import forward_flops_per_window, train_flops_per_step
from hma_jax.model.hma import declare_model
from hma_jax.training.optimizer import muon_direction
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from hma_jax.training.validation import make_sums
from tests.tiny import DIFFUSION, TABLE, model_config, random_batch, shallow_config, train_config

A, B = jnp.zeros((2, 3, 5)), jnp.zeros((2, 5, 7))
BATCHED = Product((2, 3, 5), (2, 5, 7), ((2,), (1,)), ((0,), (0,)), "float32")


def test_a_product_knows_its_size():
    assert BATCHED.matrices == (2, 3, 5, 7)
    assert BATCHED.flops == 2 * 2 * 3 * 5 * 7
    np.testing.assert_array_equal(BATCHED(A + 1, B + 1), jnp.full((2, 3, 7), 5.0))


def test_loops_count_as_often_as_they_run_and_conditions_by_their_dearest_branch():
    def loop(a, b):
        def body(carry, _):
            return carry + jnp.sum(a @ b), None

        return jax.lax.scan(body, 0.0, None, length=4)[0]

    def choice(a, b, yes):
        return jax.lax.cond(yes, lambda: a @ b, lambda: jnp.zeros((2, 3, 7)))

    assert count_products(loop, A, B) == {BATCHED: 4}
    assert count_products(jax.jit(choice), A, B, True) == {BATCHED: 1}


def test_what_nothing_needs_is_not_counted():
    assert not count_products(lambda a, b: (a @ b, a)[1], A, B)


@pytest.mark.parametrize(
    "masking",
    [
        MaskingConfig(),
        MaskingConfig(teacher_forcing=True),
        MaskingConfig(teacher_forcing=True, own_past=1.0),
        MaskingConfig(teacher_forcing=True, own_past=1.0, own_past_rounds=3),
    ],
    ids=["released", "teacher_forcing", "own_past", "three_rounds"],
)
def test_a_training_step_has_the_products_that_the_formula_counts(masking):
    model = model_config(width=128, tokens=256, action_tokens=64, frames=12, factor_vocab=512)
    train = train_config(batch=1, masking=masking)
    declared = declare_model(model, TABLE, ExecutionConfig(remat="none"))
    step = make_train_step(declared, TABLE, model, train)
    state = jax.eval_shape(lambda: init_state(declared, TABLE, 0))
    found = total_flops(count_products(step, state, random_batch(0, model, 1)))
    # More than the formula: weights of attention within frames, always computed again. Less: frame 0 is not read out.
    assert 1.0 < found / train_flops_per_step(model, TABLE, train) < 1.1


def test_muon_multiplies_what_the_page_says():
    """docs/models.md: of each layer, of each robot in it, and of each robot's stem."""
    model = model_config(width=32, layers=3)
    declared = declare_model(model, TABLE)
    hidden = {name: spec for name, spec in declared.leaves().items() if spec.role == "hidden"}

    def update(momenta):
        return [muon_direction(momenta[name], spec, 1.0, min_shard_size=2**14) for name, spec in hidden.items()]

    momenta = {name: jax.ShapeDtypeStruct(spec.shape, jnp.float32) for name, spec in hidden.items()}
    of_a_layer, of_stems = 420 + 110 * TABLE.size, 30 * TABLE.size
    assert total_flops(count_products(update, momenta)) == (model.layers * of_a_layer + of_stems) * model.width**3


@pytest.mark.parametrize("setting", ["full", "policy"])
def test_of_latents_the_denoisers_count_that_a_setting_trains(setting):
    """Those of the frames are most of a step, and a policy does not run them."""
    model, masking = shallow_config(diffusion=replace(DIFFUSION, width=128, depth=1)), MaskingConfig(setting=setting)
    declared = declare_model(model, TABLE, ExecutionConfig(remat="none"))
    batch = random_batch(0, model, 2) | {"valid": np.ones(2, bool)}
    found = total_flops(count_products(make_sums(declared, TABLE, model, masking), declared.shapes(), batch, 0))
    # Less: frame 0 of six is not read out. More: actions are multiplied in chunks of 32 values; these robots have 14.
    assert 0.8 < found / (2 * forward_flops_per_window(model, TABLE, masking)) < 1.25
