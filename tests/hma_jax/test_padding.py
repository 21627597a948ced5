"""Frames that only fill up a window of a short episode: no input, no target, no metric."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, EvalConfig, MaskingConfig, SamplerConfig
from hma_jax.evaluation.evaluate import evaluate, hold_last_frame
from hma_jax.evaluation.metrics import psnr
from hma_jax.objective.losses import bidirectional_mask
from hma_jax.training.state import init_state
from hma_jax.training.step import find_presence, make_train_step
from hma_jax.training.validation import make_sums
from tests.hma_jax.evaluation.fakes import GreyTokenizer, make_batches
from tests.tiny import DIFFUSION, SMALLER, TABLE, lively_params, mask, model_config, random_batch, train_config

FRAMES = 5
MODEL = model_config(**SMALLER | {"frames": FRAMES})
CONTINUOUS = replace(MODEL, diffusion=DIFFUSION)
LENGTHS = np.array([5, 2, 3, 4])
REAL = np.arange(FRAMES) < LENGTHS[:, None]
KINDS = [
    pytest.param(MODEL, "forward", id="forward", marks=pytest.mark.slow),
    pytest.param(MODEL, "full", id="full"),
    pytest.param(MODEL, "inverse", id="inverse", marks=pytest.mark.slow),
    pytest.param(replace(MODEL, action_alignment="causal"), "policy", id="policy", marks=pytest.mark.slow),
    pytest.param(CONTINUOUS, "full", id="continuous", marks=pytest.mark.slow),
]


def spoilt(batch: dict, other: int) -> dict:
    """The same windows with other contents where there is no frame."""
    noise = random_batch(other, MODEL if batch["tokens"].dtype == np.int32 else CONTINUOUS, len(LENGTHS))

    def fill(x: np.ndarray, new: np.ndarray) -> np.ndarray:
        real = REAL.reshape(*REAL.shape, *(1,) * (x.ndim - 2))
        return np.where(real, x, new)

    changed = {name: fill(batch[name], noise[name]) for name in ("tokens", "actions")}
    return batch | changed | {"real": REAL}


@cache
def step_of(model, masking):
    declared, params = lively_params(model)
    config = train_config(batch=len(LENGTHS), masking=masking)
    step = jax.jit(make_train_step(declared, TABLE, model, config))
    return step, init_state(declared, TABLE, 0, params=params)


@pytest.mark.parametrize("context", ["causal", "inverse"])
def test_what_is_said_of_real_frames_does_not_depend_on_padding(context):
    """Padding stands at the end: causal attention needs no mask, inverse dynamics has one."""
    declared, params = lively_params(MODEL)
    visible = bidirectional_mask(FRAMES, jnp.asarray(REAL)) if context == "inverse" else None

    @jax.jit
    def predictions(params, batch):
        out = declared.merge(params)(batch["tokens"], None, batch["actions"], batch["embodiment"], visible=visible)
        return out.token_outputs, out.action_features_BTD

    batch = random_batch(0, MODEL, len(LENGTHS))
    found = [predictions(params, spoilt(batch, other)) for other in (7, 8)]
    for one, other in zip(*found, strict=True):
        one, other = np.asarray(one), np.asarray(other)
        np.testing.assert_array_equal(one[REAL], other[REAL])
        assert (one[~REAL] != other[~REAL]).any()


@pytest.mark.parametrize(("model", "setting"), KINDS)
def test_a_step_learns_the_same_whatever_the_padding_holds(model, setting):
    step, state = step_of(model, MaskingConfig(setting=setting, prompt_frames=1))
    batch = random_batch(0, model, len(LENGTHS))
    (first, of_first), (second, of_second) = (step(state, spoilt(batch, other)) for other in (7, 8))
    assert {k: float(v) for k, v in of_first.items()} == pytest.approx(
        {k: float(v) for k, v in of_second.items()}, 1e-5
    )
    for a, b in zip(jax.tree.leaves(first.params), jax.tree.leaves(second.params), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-6)
    _, counted = step(state, {k: v for k, v in spoilt(batch, 7).items() if k != "real"})
    assert float(counted["loss"]) != float(of_first["loss"]), "the padding would have counted"
    step(state, batch | {"real": np.ones_like(REAL)})
    assert step._cache_size() == 2, "one program for windows with marks, whichever they are, and one without"


@pytest.mark.parametrize(("model", "setting"), KINDS)
def test_the_losses_of_whole_windows_are_those_without_marks(model, setting):
    series = []
    for marks in ({}, {"real": np.ones((len(LENGTHS), FRAMES), bool)}):
        step, state = step_of(model, MaskingConfig(setting=setting, prompt_frames=1))
        losses = []
        for number in range(3):
            state, metrics = step(state, random_batch(number, model, len(LENGTHS)) | marks)
            losses.append(float(metrics["loss"]))
        series.append(losses)
    assert series[0] == series[1]


def test_targets_stand_in_real_frames_alone():
    batch, masking = random_batch(0, MODEL, len(LENGTHS)), MaskingConfig(setting="full")
    key = jax.random.key(0)
    arguments = (key, batch["tokens"], batch["embodiment"], MODEL, masking, TABLE)
    everything, masked = mask(*arguments), mask(*arguments, jnp.asarray(REAL))
    np.testing.assert_array_equal(masked.targets_TS, everything.targets_TS & REAL[..., None])
    np.testing.assert_array_equal(masked.action_targets_T, everything.action_targets_T & REAL)
    assert masked.targets_TS.sum() < everything.targets_TS.sum()
    arguments = (*arguments[:4], MaskingConfig(setting="inverse"), TABLE, jnp.asarray(REAL))
    np.testing.assert_array_equal(mask(*arguments).action_targets_T.sum(1), LENGTHS - 1)
    declared, params = lively_params(MODEL)
    sums = jax.jit(make_sums(declared, TABLE, MODEL, masking))
    found = [sums(params, spoilt(batch, other) | {"valid": LENGTHS > 0}, 0) for other in (7, 8)]
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    of_all, _ = sums(params, batch | {"valid": LENGTHS > 0}, 0), None
    assert int(found[0][1].tokens) < int(of_all[1].tokens)


def test_actions_that_are_hidden_or_shown_in_padding_only_concern_nobody():
    """Otherwise the weights for these actions would decay without a gradient."""
    batch = random_batch(0, MODEL, len(LENGTHS))
    masked = mask(jax.random.key(0), batch["tokens"], batch["embodiment"], MODEL, MaskingConfig(), TABLE)
    masked = masked._replace(action_hidden_T=jnp.asarray(~REAL))
    for real, concerned in ((None, True), (jnp.asarray(REAL), False)):
        presence = find_presence(masked, batch["embodiment"], np.ones(TABLE.size, bool), MODEL, real_BT=real)
        assert bool(presence.shared["actions_hidden"]) == concerned
        shown = masked._replace(action_hidden_T=jnp.asarray(REAL))
        presence = find_presence(shown, batch["embodiment"], np.ones(TABLE.size, bool), MODEL, real_BT=real)
        assert bool(presence.shared["actions_shown"]) == concerned


# --- Evaluation ------------------------------------------------------------------------------

TOKENIZER = GreyTokenizer()
DECODE = DecodeConfig(2, temperature=0.5, sampler=SamplerConfig(steps=3))
EVAL = EvalConfig(prompt_frames=2, decode=DECODE, random_actions=2, other_actions=2)
SHORT = np.array([5, 3, 4, 5])


def judged(context: str, setting: str, padding: int | None):
    """The table of four windows, the second and third of them short (None: all whole), with `padding` in it."""
    (batch,) = make_batches(MODEL, names=("arm",), each=4)
    if padding is not None:
        real = np.arange(FRAMES) < SHORT[:, None]
        rng = np.random.default_rng(padding)
        for name in ("tokens", "actions", "images"):
            shape = (*real.shape, *(1,) * (batch[name].ndim - 2))
            noise = rng.permuted(batch[name], axis=0)
            batch[name] = np.where(real.reshape(shape), batch[name], noise).astype(batch[name].dtype)
        batch["real"] = real
    params = lively_params(MODEL)[1]
    return evaluate(params, MODEL, TABLE, TOKENIZER, [batch], replace(EVAL, context=context), setting=setting)


@pytest.mark.slow  # in every run: what padding holds reaches neither loss nor actions, here and in test_policy_padding
@pytest.mark.parametrize(
    ("context", "setting"), [("generated", "full"), ("recorded", "full"), ("generated", "inverse")]
)
def test_metrics_skip_padding(context, setting):
    whole, one, other = (judged(context, setting, padding).windows.metrics for padding in (None, 7, 8))
    short = SHORT < FRAMES
    frames = {"cross_entropy", "psnr", "psnr_last", "delta_psnr", "ssim"} if setting == "full" else set()
    assert {"action_error", *frames} <= set(one)
    for name, column in one.items():
        np.testing.assert_allclose(column, other[name], rtol=1e-5, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(column[~short], whole[name][~short], rtol=1e-5, atol=1e-5, err_msg=name)
        if name in ("cross_entropy", "psnr", "psnr_copy", "ssim", "action_error"):
            assert (column[short] != whole[name][short]).all(), name


@pytest.mark.slow
def test_a_short_window_is_judged_as_the_host_would():
    """Of window 1, three frames long, one frame is predicted: mean, last and copy are of that one."""
    (batch,) = make_batches(MODEL, names=("arm",), each=4)
    found = judged("generated", "full", 7).windows.metrics
    images = batch["images"][1]
    np.testing.assert_allclose(found["psnr"][1], found["psnr_last"][1], atol=1e-5)
    np.testing.assert_allclose(found["psnr_copy"][1], psnr(images[1], images[2]), atol=1e-5)


def test_clips_hold_their_last_real_frame():
    real = np.array([True, True, True, False, False])
    assert hold_last_frame(np.arange(5), real).tolist() == [0, 1, 2, 2, 2]
    assert hold_last_frame(np.arange(2, 5), real).tolist() == [2, 2, 2]
    assert hold_last_frame(np.arange(5), np.ones(5, bool)).tolist() == [0, 1, 2, 3, 4]


def test_a_window_without_a_frame_to_predict_is_refused():
    (batch,) = make_batches(MODEL, names=("arm",), each=4)
    batch["real"] = np.arange(FRAMES) < np.array([5, 2, 5, 5])[:, None]
    params = lively_params(MODEL)[1]
    with pytest.raises(
        ConfigError, match="a window of arm has 2 frames, so with eval.prompt_frames 2 there is nothing"
    ):
        evaluate(params, MODEL, TABLE, TOKENIZER, [batch], EVAL)
    batch["real"] = np.arange(FRAMES) < np.array([5, 1, 5, 5])[:, None]
    with pytest.raises(ConfigError, match="has 1 frames, so with eval.context recorded there is nothing .*at least 2"):
        evaluate(params, MODEL, TABLE, TOKENIZER, [batch], replace(EVAL, context="recorded"))


@pytest.mark.slow
def test_random_actions_and_errors_are_of_the_recorded_statistics():
    """A model trained on a few trajectories has a table of those; it is judged as any other."""
    (batch,) = make_batches(MODEL, names=("arm",), each=4)
    mean, std = (np.asarray(x)[batch["embodiment"]] for x in TABLE.statistics())
    batch |= {"action_mean": mean, "action_std": std}
    other = replace(TABLE, entries=tuple(replace(e, std=tuple(3 * s for s in e.std)) for e in TABLE.entries))
    params = lively_params(MODEL)[1]
    mine, theirs = (evaluate(params, MODEL, t, TOKENIZER, [batch], EVAL, setting="full") for t in (TABLE, other))
    np.testing.assert_allclose(*(r.windows.metrics["action_error_of_mean"] for r in (mine, theirs)), rtol=1e-6)
