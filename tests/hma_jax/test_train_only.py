"""Runs that train some robots' own parameters alone hold moments of these alone."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, OptimizerConfig
from hma_jax.config.training import Matrices
from hma_jax.training import train_only
from hma_jax.training.branch import begin_from
from hma_jax.training.loop import LoopOptions
from hma_jax.training.state import init_state, state_shapes
from hma_jax.training.step import make_train_step
from tests.hma_jax.test_robots import DECLARED, MODEL, OWN, SIX
from tests.hma_jax.test_training import equal_trees, train
from tests.tiny import random_batch, train_config

FREE = OptimizerConfig(learning_rate=1e-2, warmup_steps=1, weight_decay=0.1, clip_norm=1e9)
ONLY = train_config(only=("arm",))


def test_there_are_moments_of_what_is_trained_alone():
    """Of all others they were two thirds of the state of a robot that was added to forty."""
    one, whole = state_shapes(DECLARED, SIX, only=("arm2",)), state_shapes(DECLARED, SIX)
    slices = sum(spec.size // SIX.size for spec in DECLARED.leaves().values() if spec.embodiment_axis is not None)
    for moment in (one.opt_state.first, one.opt_state.second):
        assert sum(x.size for x in jax.tree.leaves(moment)) == slices
    assert one.params == whole.params and one.opt_state.count_E == whole.opt_state.count_E


@pytest.mark.parametrize(
    "matrices", [pytest.param(name, marks=[pytest.mark.slow] * (name != "adamw")) for name in get_args(Matrices)]
)
@pytest.mark.parametrize("batch", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_what_a_robot_learns_does_not_depend_on_which_others_are_trained(batch: int, matrices: str):
    """With fewer examples than robots, and with more."""
    found = {}
    for only in (("base",), ("pusher2", "base", "arm")):
        settings = train_config(batch=batch, only=only, optimizer=replace(FREE, matrices=matrices))
        state = init_state(DECLARED, SIX, 0, state_shapes(DECLARED, SIX, only=only))
        step = jax.jit(make_train_step(DECLARED, SIX, MODEL, settings))
        for number in range(3):
            state, _ = step(state, random_batch(number, MODEL, batch, SIX))
        kept = [state.opt_state.first, state.opt_state.second, train_only.pick_own(state.params, DECLARED.specs)]
        places = [sorted(only, key=SIX.index).index("base")] * 2 + [SIX.index("base")]
        found[only] = [
            np.take(np.asarray(x), place, spec.embodiment_axis)
            for tree, place in zip(kept, places, strict=True)
            for spec, x in zip(OWN, jax.tree.leaves(tree), strict=True)
        ]
    for alone, among_others in zip(*found.values(), strict=True):
        np.testing.assert_allclose(alone, among_others, rtol=1e-4, atol=1e-7)
    assert any(x.any() for x in found[("base",)])


def test_gradients_of_what_is_frozen_do_not_count_towards_the_norm_to_which_others_are_clipped():
    """A batch without the robot that is trained has no others."""
    only = ("base",)
    state = init_state(DECLARED, SIX, 0, state_shapes(DECLARED, SIX, only=only))
    step = jax.jit(make_train_step(DECLARED, SIX, MODEL, train_config(batch=3, only=only, optimizer=FREE)))
    batch = random_batch(0, MODEL, 3, SIX)
    without, among = (
        float(step(state, batch | {"embodiment": np.array([0, 1, robot], np.int32)})[1]["grad_norm"])
        for robot in (3, SIX.index("base"))
    )
    assert without == 0 < among


def test_robots_to_train_that_there_are_not_are_named():
    with pytest.raises(ConfigError, match="train.only names arm, walker, but the robots are pusher, arm, base, "):
        make_train_step(DECLARED, SIX, MODEL, train_config(only=("arm", "walker")))


def test_a_run_that_trains_some_robots_alone_resumes_exactly(tmp_path: Path):
    last = train(tmp_path / "whole", config=ONLY, options=LoopOptions(checkpoint_every=2, keep_checkpoints=3)).state
    begin_from(tmp_path / "whole", tmp_path / "run", 2)
    resumed = train(tmp_path / "run", config=ONLY)
    assert resumed.resumed_from == 2 and equal_trees(resumed.state, last)
