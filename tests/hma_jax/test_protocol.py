from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, EvalConfig
from hma_jax.evaluation.protocol import Evaluation, evaluate, random_actions
from hma_jax.model.hma import declare_model
from tests.tiny import TABLE, lively_params, model_config, random_batch

SIZE = 8
EVAL = EvalConfig(prompt_frames=2, decode=DecodeConfig(1), random_actions=3, batch=4)


class GreyTokenizer:
    """Decodes ids to flat grey images whose level is the mean id: enough for pixel metrics."""

    def decode(self, ids: np.ndarray) -> np.ndarray:
        level = (ids.mean(-1) * 4).astype(np.uint8)
        return np.broadcast_to(level[:, None, None, None], (len(ids), SIZE, SIZE, 3)).copy()


def eval_batches(config, names=("pusher", "arm"), batch=4, batches_each=2):
    window = 0
    for name in names:
        for index in range(batches_each):
            arrays = random_batch(window, config, batch)
            arrays["embodiment"][:] = TABLE.index(name)
            rng = np.random.default_rng(window)
            valid = np.arange(batch) < (2 if index == batches_each - 1 else batch)
            yield arrays | {
                "dataset": name,
                "window": np.arange(window, window + batch, dtype=np.int32),
                "valid": valid,
                "frames": rng.integers(0, 255, (batch, config.frames, SIZE, SIZE, 3)).astype(np.uint8),
            }
            window += batch


def run(params, config, settings=EVAL, **kwargs) -> Evaluation:
    return evaluate(params, config, TABLE, GreyTokenizer(), eval_batches(config, **kwargs), settings)


def test_metrics_cover_the_valid_windows_of_each_dataset():
    config = model_config()
    _, params = lively_params(config)
    result = run(params, config)
    assert set(result.datasets) == {"pusher", "arm"}
    assert all(result.datasets[name]["psnr"].n == 6 for name in result.datasets)
    assert result.overall["delta_psnr"].n == 12
    pusher, arm = (result.datasets[n]["ssim"].mean for n in ("pusher", "arm"))
    assert result.overall["ssim"].mean == pytest.approx((pusher + arm) / 2)
    assert Evaluation.from_dict(result.to_dict()).datasets == result.datasets


def test_padding_rows_do_not_count():
    config = model_config()
    _, params = lively_params(config)
    padded = run(params, config, names=("arm",), batches_each=1)
    assert padded.datasets["arm"]["psnr"].n == 2


def test_a_model_deaf_to_actions_has_no_delta_psnr():
    """Common random numbers: only actions may make a difference."""
    config = model_config()
    _, params = lively_params(config)
    deaf = jax.tree.map(lambda x: x, params)
    deaf["stem"]["out"] = jax.tree.map(jnp.zeros_like, params["stem"]["out"])
    assert abs(run(deaf, config).overall["delta_psnr"].mean) < 1e-12
    heard = run(params, config).datasets["arm"]["delta_psnr"]
    assert heard.sem > 0


def test_an_untrained_model_has_the_perplexity_of_the_vocabulary():
    config = model_config()
    result = run(declare_model(config, TABLE).init(0), config)
    assert result.overall["perplexity"].mean == pytest.approx(config.vocab_size, rel=0.02)
    assert result.overall["perplexity_corpus"].mean <= result.overall["perplexity"].mean


def test_random_actions_follow_the_robot_s_statistics_and_the_window_number():
    window = jnp.arange(400)
    draws = random_actions(0, window, jnp.full(400, 2), TABLE, (3, 6))
    assert draws.shape == (400, 3, 6, TABLE.action_width)
    np.testing.assert_allclose(np.asarray(draws[..., :3]).std((0, 1, 2)), [1.0, 0.0, 3.0], rtol=0.05)
    assert (np.asarray(draws[..., 9:]) == 0).all()
    again = random_actions(0, window[7:9], jnp.full(2, 2), TABLE, (3, 6))
    np.testing.assert_array_equal(again, draws[7:9])


def test_samples_show_true_predicted_and_randomly_driven_clips():
    config = model_config()
    _, params = lively_params(config)
    clip = run(params, config).samples["arm"]
    assert {k: v.shape for k, v in clip.items()} == {
        k: (1, config.frames, SIZE, SIZE, 3) for k in ("true", "predicted", "random")
    }
    np.testing.assert_array_equal(clip["true"][:, :2], clip["predicted"][:, :2])


def test_after_recorded_frames_every_frame_but_the_first_is_predicted():
    config = model_config()
    _, params = lively_params(config)
    recorded, generated = (run(params, config, replace(EVAL, context=c)) for c in ("recorded", "generated"))
    clip = recorded.samples["arm"]
    assert set(clip) == {"true", "predicted"}
    assert clip["predicted"].shape[1] == config.frames
    same, other = (e.datasets["arm"]["cross_entropy"].mean for e in (recorded, generated))
    assert same == pytest.approx(other, rel=1e-5)  # the likelihood is that of recorded frames in both
    assert recorded.overall["delta_psnr"].sem > 0
    deaf = jax.tree.map(lambda x: x, params)
    deaf["stem"]["out"] = jax.tree.map(jnp.zeros_like, params["stem"]["out"])
    quiet = run(deaf, config, replace(EVAL, context="recorded"))
    assert abs(quiet.overall["delta_psnr"].mean) < 1e-12


def test_windows_longer_than_the_model_s_are_continued_past_it():
    config = model_config()
    _, params = lively_params(config)
    batches = lambda frames: eval_batches(model_config(frames=frames), names=("arm",), batches_each=1)  # noqa: E731
    judge = lambda b, c: evaluate(params, config, TABLE, GreyTokenizer(), b, c)  # noqa: E731
    decodings = (DecodeConfig(1, slide=slide) for slide in ("exact", "streaming"))
    exact, streamed = (judge(batches(9), replace(EVAL, decode=decode)) for decode in decodings)
    clips = [e.samples["arm"]["predicted"] for e in (exact, streamed)]
    assert clips[0].shape[1] == 9
    np.testing.assert_array_equal(clips[0][:, : config.frames], clips[1][:, : config.frames])
    whole, *_ = batches(9)
    short = {k: v[:, : config.frames] if k in ("tokens", "actions", "frames") else v for k, v in whole.items()}
    want = judge(iter([short]), EVAL).overall["cross_entropy"].mean
    assert exact.overall["cross_entropy"].mean == pytest.approx(want, rel=1e-6)
    with pytest.raises(ConfigError, match="windows have the model's 6 frames, got 9"):
        judge(batches(9), replace(EVAL, context="recorded"))


def test_a_prompt_that_fills_the_window_is_refused():
    config = model_config()
    _, params = lively_params(config)
    with pytest.raises(ConfigError, match="leaves nothing to predict"):
        evaluate(params, config, TABLE, GreyTokenizer(), iter([]), EvalConfig(prompt_frames=6))
