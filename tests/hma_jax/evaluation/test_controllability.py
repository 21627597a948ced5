"""Whether actions are told apart: by models that read them, by one that is deaf, and by their frames."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import DecodeConfig, EvalConfig, SamplerConfig
from hma_jax.evaluation.controllability import action_metrics, counterfactual, for_each_sequence
from hma_jax.evaluation.evaluate import Evaluation, evaluate
from hma_jax.evaluation.measures import OPTIONAL_METRICS
from hma_jax.evaluation.metrics import MAX_PSNR, psnr
from hma_jax.evaluation.summary import paired_difference
from tests.hma_jax.evaluation.fakes import GreyTokenizer, make_batches
from tests.tiny import DIFFUSION, TABLE, lively_params, model_config

OTHERS = 15
DECODE = DecodeConfig(2, temperature=0.5, sampler=SamplerConfig(steps=3))
EVAL = EvalConfig(prompt_frames=2, decode=DECODE, random_actions=3)
TOKENIZER = GreyTokenizer()


def with_others(config, each: int = 4):
    """Batches of 4 windows: of `pusher`, whose other frames are known, and of `arm`, whose are not; the first window of
    `arm` has no other episode."""
    for batch in make_batches(config, each=each):
        rng = np.random.default_rng(7)
        own = np.abs(batch["actions"]).max((0, 1)) > 0  # padding of narrower robots stays zero
        noise = rng.normal(size=(len(own), *batch["actions"].shape[1:2], OTHERS, len(batch["actions"])))
        other = np.moveaxis(noise, (0, 1, 2, 3), (3, 2, 1, 0)).astype(np.float32) * own
        pusher = np.asarray([name == "pusher" for name in batch["dataset"]])
        valid = np.ones((len(pusher), OTHERS), bool)
        valid[~pusher & (batch["episode"] == 0) & (batch["start"] == 0)] = False
        images = rng.integers(0, 255, batch["images"].shape).astype(np.uint8)
        images[:, :2] = batch["images"][:, :2]
        yield batch | {
            "other_actions": other, "other_valid": valid, "other_images": images, "other_seen": pusher,
        }  # fmt: skip


def run(params, config) -> Evaluation:
    return evaluate(params, config, TABLE, TOKENIZER, with_others(config), EVAL)


@pytest.fixture(scope="module", params=[None, pytest.param(DIFFUSION, marks=pytest.mark.slow)], ids=["ids", "latents"])
def models(request):
    """(config, one that reads actions, one that does not)."""
    config = model_config(diffusion=request.param)
    params = lively_params(config)[1]
    deaf = jax.tree.map(lambda x: x, params)
    deaf["stem"]["out"] = jax.tree.map(jnp.zeros_like, params["stem"]["out"])
    return config, run(params, config), run(deaf, config)


def test_a_model_deaf_to_actions_tells_nothing_apart(models):
    """To the last bit: every sequence is judged by one program."""
    _, reads, deaf = models
    some = ~np.isnan(deaf.windows.metrics["action_nats"])
    for metric, want in (
        ("action_nats", 0),
        ("retrieval", 1 / 16),
        ("retrieval_rank", 8.5),
        ("retrieval_chance", 1 / 16),
    ):
        np.testing.assert_array_equal(deaf.windows.metrics[metric][some], np.float32(want))
    assert deaf.summary.datasets["pusher"]["counterfactual_gain"].mean == 0
    assert np.abs(reads.windows.metrics["action_nats"][some]).min() > 0
    assert set(np.unique(reads.windows.metrics["retrieval"][some])) <= {0.0, 1.0}
    assert reads.summary.datasets["pusher"]["counterfactual_gain"].mean != 0


@pytest.mark.slow
def test_the_likelihood_is_the_same_with_and_without_others(models):
    config, reads, _ = models
    alone = evaluate(lively_params(config)[1], config, TABLE, TOKENIZER, make_batches(config, each=4), EVAL)
    for metric, column in alone.windows.metrics.items():
        np.testing.assert_allclose(reads.windows.metrics[metric], column, rtol=1e-5, atol=1e-5, err_msg=metric)
    assert not set(OPTIONAL_METRICS) & set(alone.windows.metrics)


def test_what_a_window_has_not_is_left_out_of_means(models):
    _, reads, deaf = models
    missing = np.isnan(reads.windows.metrics["action_nats"])
    assert [name for name, no in zip(reads.windows.names, missing, strict=True) if no] == [("arm", 0, 0)]
    found = reads.summary.datasets
    assert (found["arm"]["action_nats"].n, found["pusher"]["action_nats"].n) == (3, 4)
    assert "counterfactual_psnr" in found["pusher"] and "counterfactual_psnr" not in found["arm"]
    overall = reads.summary.overall
    assert overall["counterfactual_psnr"].mean == found["pusher"]["counterfactual_psnr"].mean
    assert overall["action_nats"].n == 7 and math.isfinite(overall["action_nats"].mean)
    difference = paired_difference(reads.windows, deaf.windows, 1).datasets
    assert difference["arm"]["action_nats"].n == 3 and "counterfactual_gain" not in difference["arm"]
    assert difference["arm"]["action_nats"].mean == pytest.approx(found["arm"]["action_nats"].mean)


def test_clips_show_what_is_true_under_other_actions(models):
    _, reads, _ = models
    clips = reads.samples["pusher"]
    (batch, *_) = with_others(model_config())
    np.testing.assert_array_equal(clips["other_true"][0], batch["other_images"][0])
    assert clips["other"].shape == clips["true"].shape
    score = psnr(clips["other"][0, 2:], clips["other_true"][0, 2:]).mean()
    assert score == pytest.approx(reads.windows.metrics["counterfactual_psnr"][0], abs=1e-4)
    assert "other" not in reads.samples["arm"]


# --- By hand ----------------------------------------------------------------------------------


def test_a_model_that_reads_actions_finds_the_true_ones():
    """One whose loss is how far the actions are from those that made the frames."""
    actions, others = (jax.random.normal(jax.random.key(s), shape) for s, shape in ((0, (5, 6, 2)), (1, (5, 15, 6, 2))))

    def judge(given):
        return {"loss": jnp.square(given - actions).mean((1, 2))}

    losses = for_each_sequence(judge, actions, others)["loss"]
    tell_apart = jax.jit(action_metrics)
    found = tell_apart(losses, jnp.ones((5, 15), bool))
    assert losses.shape == (16, 5)
    np.testing.assert_array_equal(found["retrieval"], 1)
    np.testing.assert_array_equal(found["retrieval_rank"], 1)
    np.testing.assert_allclose(found["action_nats"], losses[1:].mean(0), rtol=1e-6)
    shifted = tell_apart(for_each_sequence(judge, others[:, 0], others)["loss"], jnp.ones((5, 15), bool))
    assert (shifted["retrieval_rank"] > 1).all()  # the control: they made other frames


def test_ranks_count_better_ones_and_halve_ties():
    losses = jnp.asarray([[2.0], [1.0], [2.0], [3.0], [0.0]])  # the truth, then four others
    valid = jnp.asarray([[True, True, True, False]])
    tell_apart = jax.jit(action_metrics)
    found = {name: float(x[0]) for name, x in tell_apart(losses, valid).items()}
    assert found == {"action_nats": 0.0, "retrieval": 0.0, "retrieval_rank": 2.5, "retrieval_chance": 0.25}
    tied = tell_apart(jnp.asarray([[1.0], [1.0], [4.0]]), jnp.ones((1, 2), bool))
    assert float(tied["retrieval"][0]) == 0.5
    nobody = tell_apart(losses, jnp.zeros((1, 4), bool))
    assert all(np.isnan(x).all() for x in nobody.values()) and set(nobody) < set(OPTIONAL_METRICS)


def test_a_rollout_that_goes_where_the_other_actions_lead_gains():
    rng = np.random.default_rng(0)
    truth, shown, before = (jnp.asarray(rng.integers(0, 255, (3, n, 8, 8, 3)), jnp.uint8) for n in (4, 4, 1))
    real = jnp.asarray([[True] * 4, [True, True, False, False], [True] * 4])
    judge = jax.jit(counterfactual)
    right = judge(shown, truth, truth, before, jnp.asarray([True, True, False]), real)
    np.testing.assert_allclose(right["counterfactual_psnr"], [MAX_PSNR, MAX_PSNR, np.nan], rtol=1e-6)
    want = MAX_PSNR - psnr(np.asarray(shown), np.asarray(truth))
    np.testing.assert_allclose(right["counterfactual_gain"][:2], [want[0].mean(), want[1, :2].mean()], rtol=1e-5)
    ignores = judge(shown, shown, truth, before, jnp.ones(3, bool), real)
    np.testing.assert_array_equal(ignores["counterfactual_gain"], 0)
    copied = psnr(np.repeat(np.asarray(before), 4, axis=1), np.asarray(truth))
    copied = [copied[0].mean(), copied[1, :2].mean(), copied[2].mean()]
    np.testing.assert_allclose(ignores["counterfactual_copy"], copied, rtol=1e-5)
