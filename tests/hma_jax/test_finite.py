"""A model's step says when a gradient or an update is not finite, whatever its loss is."""

from __future__ import annotations

import math
from pathlib import Path

import jax.numpy as jnp
import pytest

from hma_jax.training import step as step_module
from hma_jax.training.divergence import DivergedError
from hma_jax.training.loop import LoopOptions
from hma_jax.training.runs import load_run
from hma_jax.training.train import train_model
from tests.tiny import SMALLER, TABLE, batches, model_config, train_config

MODEL = model_config(**SMALLER)
MARK = MODEL.vocab_size - 1
"""As the very first token of a batch, it marks the step that goes wrong."""


def marked(at: int):
    """Batches of which that of step `at` is marked."""

    def make(start: int):
        for step, batch in enumerate(batches(MODEL, 4)(start), start + 1):
            batch["tokens"][0, 0, 0] = MARK if step == at else 0
            yield batch

    return make


def train(run_dir: Path, at: int):
    return train_model(
        MODEL, TABLE, train_config(batch=4), marked(at), run_dir=run_dir, provenance={},
        options=LoopOptions(checkpoint_every=1),
    )  # fmt: skip


def test_a_gradient_that_is_no_number_is_refused_though_the_loss_is_fine(tmp_path: Path, monkeypatch):
    usual = step_module.masked_loss

    def poisoned(model, masked, tokens, *rest, **how):
        sums = usual(model, masked, tokens, *rest, **how)
        nothing = 0 * model.positions.get_value().sum()
        bad = tokens[0, 0, 0] == MARK
        # A root of 0 is 0, and its slope infinite.
        return sums._replace(tokens=sums.tokens + jnp.where(bad, jnp.sqrt(jnp.where(bad, nothing, 1.0)), 0.0))

    monkeypatch.setattr(step_module, "masked_loss", poisoned)
    with pytest.raises(DivergedError, match=r"the gradient and the update are not finite at step 3 \(its loss is 2"):
        train(tmp_path, at=3)
    assert load_run(tmp_path).step == 2


@pytest.mark.slow
def test_an_update_that_is_infinite_is_refused_though_the_gradient_is_fine(tmp_path: Path, monkeypatch):
    usual = step_module.apply_update

    def poisoned(grads, state, params, *rest):
        moved, after = usual(grads, state, params, *rest)
        bad = state.count["always"] == 5  # steps before this one
        table = moved["embed"]["tables"]
        moved["embed"]["tables"] = table.at[0].add(jnp.where(bad, math.inf, 0.0))
        return moved, after

    monkeypatch.setattr(step_module, "apply_update", poisoned)
    with pytest.raises(DivergedError, match=r"the update is not finite at step 6 \(its loss is 2"):
        train(tmp_path, at=0)  # the very last step
    assert load_run(tmp_path).step == 5
