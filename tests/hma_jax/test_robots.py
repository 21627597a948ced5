"""Which robots' parameters a step computes with."""

from __future__ import annotations

import functools
import re
from dataclasses import replace

import jax
import numpy as np
import pytest

from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import is_spec
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from tests.tiny import SMALLER, TABLE, model_config, random_batch, train_config

MODEL = model_config(**SMALLER)
SIX = EmbodimentTable(tuple(replace(e, name=e.name + twin) for twin in ("", "2") for e in TABLE.entries))
DECLARED = declare_model(MODEL, SIX)
OWN = [spec for spec in jax.tree.leaves(DECLARED.specs, is_leaf=is_spec) if spec.embodiment_axis is not None]


@functools.cache
def compiled(batch: int):
    """A step of `batch` windows, which is given its state to write over, compiled."""
    step = make_train_step(DECLARED, SIX, MODEL, train_config(batch=batch))
    given = jax.eval_shape(lambda: init_state(DECLARED, SIX, 0)), random_batch(0, MODEL, batch, SIX)
    return jax.jit(step, donate_argnums=0).lower(*given).compile()


@pytest.mark.parametrize("batch", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_step_writes_robots_slices_in_place(batch: int):
    """A copy of all robots' arrays at every step takes most of the time of a small batch."""
    _, entry = compiled(batch).as_text().split("\nENTRY ")
    copies = {tuple(map(int, re.findall(r"\d+", shape))) for shape in re.findall(r"= f32(\[[\d,]*\])\S* copy\(", entry)}
    assert copies and OWN and not copies & {spec.shape for spec in OWN}


def test_a_step_of_one_window_moves_its_robot_alone():
    step, batch = compiled(1), random_batch(0, MODEL, 1, SIX)
    for robot in (0, 3):
        before = jax.device_get(init_state(DECLARED, SIX, 0))
        after = jax.device_get(
            step(init_state(DECLARED, SIX, 0), batch | {"embodiment": np.array([robot], np.int32)})[0]
        )
        moved_E = np.zeros(SIX.size, bool)
        for old, new in ((before.params, after.params), (before.opt_state.first, after.opt_state.first)):
            for spec, *pair in zip(
                *(jax.tree.leaves(x, is_leaf=is_spec) for x in (DECLARED.specs, old, new)), strict=True
            ):
                if spec.embodiment_axis is not None:
                    a, b = (np.moveaxis(x, spec.embodiment_axis, 0).reshape(SIX.size, -1) for x in pair)
                    moved_E |= (a != b).any(axis=1)
        assert np.flatnonzero(moved_E).tolist() == [robot]
        assert np.flatnonzero(after.opt_state.count_E["always"]).tolist() == [robot]
