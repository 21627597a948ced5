"""The protocol over batches: what is measured, on which windows, where, and with how much memory."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, EvalConfig, ExecutionConfig, MeshConfig, SamplerConfig
from hma_jax.evaluation import evaluate as module
from hma_jax.evaluation import protocol
from hma_jax.evaluation.evaluate import Evaluation, evaluate, in_groups, make_evaluator, one_ahead, plan_groups
from hma_jax.evaluation.images import decode_in_pieces
from hma_jax.evaluation.measures import METRICS, OF_WINDOWS
from hma_jax.evaluation.metrics import factored_cross_entropy, psnr, ssim
from hma_jax.evaluation.protocol import evaluation_inputs
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import WindowTable
from hma_jax.generation import next_frame_outputs, rollout
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.frames import compose
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params, inference_params
from hma_jax.model.readout import choose_likeliest
from hma_jax.training.adapt import add_embodiments
from tests.hma_jax.evaluation.fakes import SIZE, GreyTokenizer, make_batches
from tests.tiny import DIFFUSION, TABLE, lively_params, shallow_config

DECODE = DecodeConfig(2, temperature=0.5, sampler=SamplerConfig(steps=3))  # every kind of random number is drawn
EVAL = EvalConfig(prompt_frames=2, decode=DECODE, random_actions=3, other_actions=2)
CONFIG = shallow_config()
FOUND = {"finite": np.ones(4, bool)}  # what an evaluator that computes nothing finds in four windows
TOKENIZER = GreyTokenizer()  # one for all: an evaluator is compiled for a tokenizer


@pytest.fixture(scope="module")
def params():
    return lively_params(CONFIG)[1]


def run(params, config=CONFIG, settings=EVAL, execution=ExecutionConfig(), **kwargs) -> Evaluation:
    batches = make_batches(config, **kwargs)
    result = evaluate(params, config, TABLE, TOKENIZER, batches, settings, execution=execution)
    measured = {*result.windows.metrics, *result.summary.overall}
    assert measured <= METRICS.keys(), "add what is measured to hma_jax/evaluation/measures.py"
    return result


def test_metrics_cover_the_valid_windows_of_each_dataset(params):
    result = run(params, each=5)  # in three batches: one of both datasets, the last padded
    assert result.windows.datasets == ("pusher", "arm")
    assert result.windows.names == [
        (name, number // 2, number % 2 * 12) for name in ("pusher", "arm") for number in range(5)
    ]
    stats = result.summary.datasets
    assert all((s["psnr"].n, s["psnr"].episodes) == (5, 3) for s in stats.values())
    assert (result.summary.overall["delta_psnr"].n, result.summary.overall["delta_psnr"].episodes) == (10, 6)
    pusher, arm = (stats[n]["ssim"].mean for n in ("pusher", "arm"))
    assert result.summary.overall["ssim"].mean == pytest.approx((pusher + arm) / 2)


def test_what_is_said_to_depend_on_windows_alone_is_the_same_for_every_model(params):
    tables = [run(own, each=5).windows for own in (params, jax.tree.map(lambda x: -np.asarray(x), params))]
    a, b = (table.metrics for table in tables)
    same = {name for name in a if np.array_equal(a[name], b[name], equal_nan=True)}
    assert same == {"psnr_copy"} == set(a) & set(OF_WINDOWS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": None, "valid": None}, "a batch to evaluate lacks images, valid"),
        ({"tokens": 64}, "got ids from 64 to 64, but the model allows 0 to 63"),
        ({"embodiment": 3}, "got robots from 3 to 3, but the model allows 0 to 2"),
        ({"actions": np.nan}, "the actions are not finite"),
        ({"valid": False}, "no windows: all rows of its batches are padding"),
    ],
    ids=lambda value: "" if isinstance(value, str) else "-".join(value),
)
def test_batches_that_are_not_as_they_should_be_are_refused(params, changes, message, monkeypatch):
    """Numbers came of unknown ids and robots, and of no window at all."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    changed = {name: np.full_like(batch[name], value) for name, value in changes.items() if value is not None}
    given = {name: x for name, x in (batch | changed).items() if changes.get(name, 0) is not None}
    monkeypatch.setattr(module, "make_evaluator", lambda *_: lambda *_: (FOUND, None))
    with pytest.raises(ConfigError, match=message):
        evaluate(params, CONFIG, TABLE, TOKENIZER, [given], EVAL)


def test_parameters_of_another_model_are_not_evaluated(params):
    with pytest.raises(ConfigError, match="these parameters are not those of the model: .* should be"):
        evaluate({}, CONFIG, TABLE, TOKENIZER, [], EVAL)


def test_parameters_are_cast_once_not_in_every_pass(params, monkeypatch):
    """A trial's are those of training, in float32: forty robots' matrices were cast in each pass of a rollout."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    given: list[Params] = []
    monkeypatch.setattr(module, "make_evaluator", lambda *_: lambda weights, *_: given.append(weights) or (FOUND, None))
    evaluate(params, CONFIG, TABLE, TOKENIZER, [batch], EVAL, execution=ExecutionConfig(dtype="bfloat16"))
    want = inference_params(declare_model(CONFIG, TABLE), params, "bfloat16")
    assert jax.tree.map(lambda x: x.dtype, given[0]) == jax.tree.map(lambda x: x.dtype, want)
    assert given[0]["trunk"]["blocks"]["mlp_in"]["kernel"].dtype == "bfloat16"


@pytest.mark.parametrize(
    ("platform", "memory", "whole"),
    [("gpu", 800, True), ("gpu", 799, False), ("gpu", None, False), ("cpu", None, True)],
    ids=["fit", "do not", "unknown", "CPU"],
)
def test_parameters_that_fit_are_not_gathered_again_in_every_pass(platform, memory, whole, monkeypatch):
    """An eighth of a device's memory, split along `tensor` alone."""
    stats = None if memory is None else {"bytes_limit": memory}
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    device = SimpleNamespace(platform=platform, memory_stats=lambda: stats)
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    config = MeshConfig(1, -1, 2, min_shard_size=5)
    want = MeshConfig(4, 1, 2, min_shard_size=5) if whole else config
    assert module.evaluation_mesh(config, {"w": np.zeros(50, np.float32)}) == want


def test_images_are_compared_as_the_host_would(params):
    """The rollout of the library, decoded by the tokenizer's own `decode`, in float64; the likelihood is that of the
    frames after the first."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    result = evaluate(params, CONFIG, TABLE, TOKENIZER, iter([batch]), EVAL)

    @jax.jit
    def roll_out(params, batch):
        sequences, keys = evaluation_inputs(batch, TABLE, EVAL)
        hma = declare_model(CONFIG, TABLE).merge(params)
        out = next_frame_outputs(hma, batch["tokens"], batch["actions"], batch["embodiment"])
        logits = hma.logits(out, batch["tokens"][:, 1:])
        likeliest = compose(hma.frame_head.decode_factors(out, choose_likeliest)[0], CONFIG.factor_vocab)
        return rollout(hma, batch["tokens"][:, :2], sequences, batch["embodiment"], keys, DECODE), logits, likeliest

    inputs = {k: batch[k] for k in ("tokens", "actions", "embodiment", "episode", "start")}
    made, logits, likeliest = roll_out(params, inputs)
    followed = batch["tokens"][:, 1:]
    images = TOKENIZER.decode(np.asarray(made).reshape(-1, CONFIG.tokens)).reshape(4, 4, 4, SIZE, SIZE, 3)
    true, last = batch["images"][:, 2:], batch["images"][:, -1]
    random = np.stack([psnr(images[:, r, -1], last) for r in (1, 2, 3)], axis=1)
    want = {
        "cross_entropy": factored_cross_entropy(logits, followed).mean((1, 2)),
        "accuracy": (likeliest == followed).mean((1, 2)),
        "psnr": psnr(images[:, 0], true).mean(1),
        "psnr_last": psnr(images[:, 0, -1], last),
        "psnr_random": random.mean(1),
        "delta_psnr": psnr(images[:, 0, -1], last) - random.mean(1),
        "psnr_copy": psnr(np.repeat(batch["images"][:, 1:2], 4, axis=1), true).mean(1),
        "ssim": ssim(images[:, 0], true).mean(1),
    }
    for metric, values in want.items():
        np.testing.assert_allclose(result.windows.metrics[metric], values, rtol=0, atol=1e-5, err_msg=metric)


def test_actions_differ_from_the_chunk_that_leads_to_the_first_predicted_frame(params, monkeypatch):
    """Random ones, and those of another episode; every seed draws its own."""

    class Asked(Exception):
        """What is to be rolled out."""

    def ask(hma, prompt, sequences, robots, keys, *_, **__):
        raise Asked(sequences, keys)

    def asked_with(seed: int, batch):
        with pytest.raises(Asked) as asked:
            protocol.make_predictor(CONFIG, TABLE, replace(EVAL, seed=seed))(params, batch)
        return asked.value.args

    monkeypatch.setattr(protocol, "rollout", ask)
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    inputs = {k: batch[k] for k in ("tokens", "actions", "embodiment", "episode", "start", "images")}
    own, first, live = batch["actions"][:, None], EVAL.prompt_frames - 1, TABLE.entries[TABLE.index("arm")].chunk
    inputs |= {"other_actions": own + 1, "other_valid": np.ones((4, 1), bool), "other_images": batch["images"]}
    (sequences, keys), (reseeded, other_keys) = jax.jit(lambda batch: [asked_with(seed, batch) for seed in (0, 1)])(
        inputs
    )
    random, draws = sequences[:, 1:-1], EVAL.random_actions
    assert random.shape[1] == draws
    np.testing.assert_array_equal(sequences[:, 0], own[:, 0])
    np.testing.assert_array_equal(sequences[:, :, :first], np.repeat(own[:, :, :first], 2 + draws, axis=1))
    np.testing.assert_array_equal(sequences[:, -1:, first:], own[:, :, first:] + 1)
    for others in (own, reseeded[:, 1:-1]):
        assert (random != others)[:, :, first:, :live].all()
    assert (jax.random.key_data(keys) != jax.random.key_data(other_keys)).any(-1).all()


def test_random_actions_follow_the_statistics_of_the_batch():
    """Those of all recorded actions, which the table of a model that saw few trajectories does not know."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    mean, std = (np.full((4, TABLE.action_width), value, np.float32) for value in (5, 0.5))
    given = batch | {"action_mean": mean, "action_std": std}
    sequences, _ = jax.jit(lambda: evaluation_inputs(given, TABLE, replace(EVAL, random_actions=64)))()
    drawn = np.asarray(sequences[:, 1:, EVAL.first_predicted - 1 :])
    assert drawn.mean() == pytest.approx(5, abs=0.05) and drawn.std() == pytest.approx(0.5, abs=0.05)


NEWCOMERS = (
    Embodiment("humanoid", 26, 3, (0.1,) * 26, (2.0,) * 26),  # wider than anyone before
    Embodiment("film", 0, 1, (), ()),  # no actions at all
)


@pytest.mark.slow  # in every run: test_adapt, and test_draws for the random actions
@pytest.mark.parametrize("diffusion", [None, DIFFUSION], ids=["discrete", "continuous"])
def test_new_robots_change_no_number_of_the_old_ones(diffusion):
    """Random actions, decoding, likelihood and policy: all random numbers are a window's own."""
    config = shallow_config(diffusion=diffusion)
    _, params = lively_params(config)
    wider, table = add_embodiments(params, config, TABLE, NEWCOMERS, seed=3)
    inputs, found = [], []
    for weights, robots in ((params, TABLE), (wider, table)):
        batches = list(make_batches(config, names=("base", "arm"), each=4, table=robots))
        arrays = {k: jnp.asarray(batches[1][k]) for k in ("actions", "embodiment", "episode", "start")}
        sequences, _ = jax.jit(lambda a, robots=robots: evaluation_inputs(a, robots, EVAL))(arrays)
        inputs.append(sequences[..., : TABLE.action_width])
        found.append(evaluate(weights, config, robots, TOKENIZER, batches, EVAL, setting="full").windows)
    np.testing.assert_array_equal(*inputs)
    old, new = found
    assert old.names == new.names and "action_error" in old.metrics
    for metric, column in old.metrics.items():
        np.testing.assert_allclose(new.metrics[metric], column, rtol=1e-4, atol=1e-4, err_msg=metric)


def test_robots_without_actions_have_no_error_of_predicted_ones(monkeypatch):
    """They do not count as predicted without error in the mean over robots."""
    (batch,) = make_batches(CONFIG, each=2)
    monkeypatch.setattr(protocol, "predict_actions", lambda model, tokens, actions, *_, **__: actions + 1)
    window = protocol.Recorded(batch["tokens"], batch["actions"], batch["embodiment"])
    mean, std = (np.asarray(x)[batch["embodiment"]] for x in TABLE.statistics())
    film = np.asarray(batch["dataset"]) == "arm"
    statistics = (mean, np.where(film[:, None], 0, std))
    found = protocol._policy_errors(CONFIG, window, None, EVAL, causally=False, statistics=statistics, real_BT=None)
    names, frames = np.asarray(batch["dataset"]), np.full(len(film), CONFIG.frames)
    windows = WindowTable(names, batch["episode"], batch["start"], frames, {k: np.asarray(x) for k, x in found.items()})
    summary = summarise(windows, 1)
    of_robots, overall = summary.datasets, summary.overall
    for name in ("action_error", "action_error_of_mean", "action_gain"):
        assert name not in of_robots["arm"] and overall[name].mean == of_robots["pusher"][name].mean != 0


def test_a_window_that_ends_before_the_prompt_has_no_error_of_predicted_actions(monkeypatch):
    """With recorded frames a window needs no more than two; its error was 0, a perfect prediction."""
    (batch,) = make_batches(CONFIG, each=2)
    monkeypatch.setattr(protocol, "predict_next_actions", lambda model, tokens, actions, *_: actions + 1)
    config = replace(EVAL, context="recorded", prompt_frames=3)
    window = protocol.Recorded(batch["tokens"], batch["actions"], batch["embodiment"])
    mean, std = (np.asarray(x)[batch["embodiment"]] for x in TABLE.statistics())
    real = np.arange(CONFIG.frames) < np.array([2, 3, 4, CONFIG.frames])[:, None]
    found = protocol._policy_errors(CONFIG, window, None, config, causally=True, statistics=(mean, std), real_BT=real)
    found = found["action_error"]
    np.testing.assert_array_equal(np.isnan(found), [True, False, False, False])
    np.testing.assert_allclose(found[1:3], [np.mean(own[own > 0] ** -2.0) for own in std[1:3]], rtol=1e-3)
    with pytest.raises(ConfigError, match="eval.prompt_frames 9 leaves no action to evaluate in a window of"):
        protocol.make_predictor(CONFIG, TABLE, replace(config, prompt_frames=9), "policy")


@pytest.mark.parametrize("short", [False, True])
def test_inverse_dynamics_is_not_judged_by_what_follows_the_last_frame(short, monkeypatch):
    """No frame shows where that chunk led; its error was part of the mean."""
    (batch,) = make_batches(CONFIG, each=2)
    lengths = np.array([2, 3, 4, 6]) if short else np.full(4, CONFIG.frames)
    wrong = np.arange(CONFIG.frames) >= lengths[:, None] - 1
    monkeypatch.setattr(protocol, "predict_actions", lambda _, __, actions, *_a, **_k: actions + wrong[..., None])
    window = protocol.Recorded(batch["tokens"], batch["actions"], batch["embodiment"])
    statistics = [np.asarray(x)[batch["embodiment"]] for x in TABLE.statistics()]
    real = np.arange(CONFIG.frames) < lengths[:, None]
    real = real if short else None
    found = protocol._policy_errors(CONFIG, window, None, EVAL, causally=False, statistics=statistics, real_BT=real)
    np.testing.assert_array_equal(found["action_error"], [np.nan if short else 0, 0, 0, 0])
    assert found["finite"].all() and found["action_error_of_mean"][1:].all()
    settings = replace(EVAL, prompt_frames=CONFIG.frames)
    with pytest.raises(ConfigError, match="eval.prompt_frames 6 leaves no action to evaluate"):
        protocol.make_predictor(CONFIG, TABLE, settings, "inverse")


@pytest.mark.parametrize("frames", [1, 3])
def test_a_policy_is_judged_after_a_prompt_that_fills_the_window(frames, monkeypatch):
    """The last chunk follows the last frame, so there is one to judge."""
    config = shallow_config(frames=frames)
    (batch,) = make_batches(config, names=("arm",), each=4)
    batch["real"] = np.ones((4, frames), bool)
    monkeypatch.setattr(protocol, "predict_next_actions", lambda model, tokens, actions, *_: actions)
    settings = replace(EVAL, prompt_frames=frames)
    found = evaluate(
        declare_model(config, TABLE).init(0), config, TABLE, TOKENIZER, [batch], settings, setting="policy"
    )
    np.testing.assert_array_equal(found.windows.metrics["action_error"], 0)
    with pytest.raises(ConfigError, match="a window of arm has .* there is nothing to predict"):
        module._check_lengths(batch | {"real": np.arange(frames) < np.array([[frames - 1]] * 4)}, settings, "policy")


@pytest.mark.parametrize("setting", ["policy", "inverse"])
def test_what_was_trained_for_actions_alone_is_judged_by_them_alone(params, setting):
    """Its frames were said to have a perplexity and a PSNR, of a head that nothing had trained."""
    batches = list(make_batches(CONFIG, each=2))
    found = evaluate(params, CONFIG, TABLE, TOKENIZER, batches, EVAL, setting=setting)
    actions = {"action_error", "action_error_of_mean", "action_gain"}
    assert found.windows.metrics.keys() == found.summary.overall.keys() == actions and not found.samples
    broken = jax.tree.map(lambda x: jax.device_put(np.full_like(x, np.nan)), params)
    with pytest.raises(ConfigError, match=r"predictions are not finite \(arm, pusher\); did the model diverge"):
        evaluate(broken, CONFIG, TABLE, TOKENIZER, batches, EVAL, setting=setting)


def test_ids_chosen_by_logits_that_are_no_numbers_are_not_judged(params):
    """Ids are whole numbers whatever chose them, and among losses that are no numbers the true actions were found."""
    broken = jax.tree.map(lambda x: jax.device_put(np.full_like(x, np.nan)), params)
    with pytest.raises(ConfigError, match=r"predictions are not finite \(pusher\); did the model diverge"):
        run(broken)


@pytest.mark.parametrize("wrong", ["actions", "the loss under another episode's actions"])
def test_no_part_of_what_is_predicted_may_be_no_number(wrong, params, monkeypatch):
    """Both metrics are NaN where a window has nothing to judge, and were so left out of means."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    inputs = {k: batch[k] for k in ("tokens", "actions", "embodiment", "episode", "start")}
    losses = np.zeros((3, 4), np.float32)
    if wrong == "actions":
        inputs["actions"] = inputs["actions"] + np.nan
    else:
        losses[1:, 2:] = np.nan
    found = {"cross_entropy": jnp.asarray(losses), "finite": jnp.isfinite(losses)}
    inputs |= {"other_actions": np.zeros((4, 2, 6, 1)), "other_valid": np.array([[True] * 2] * 3 + [[False] * 2])}
    monkeypatch.setattr(protocol, "rollout", lambda _, prompt, sequences, *__, **___: jnp.zeros((4, 4, 4, 9)))
    monkeypatch.setattr(protocol, "for_each_sequence", lambda *_: found)
    monkeypatch.setattr(protocol, "predict_next_actions", lambda model, tokens, actions, *_: actions)
    metrics, _ = jax.jit(protocol.make_predictor(CONFIG, TABLE, EVAL, "full"))(params, inputs)
    finite = [False] * 4 if wrong == "actions" else [True, True, False, True]
    np.testing.assert_array_equal(metrics["finite"], finite)


@pytest.mark.slow
def test_latents_that_are_no_numbers_are_not_decoded_into_images():
    config = shallow_config(diffusion=DIFFUSION)
    broken = jax.tree.map(lambda x: x * jnp.nan, lively_params(config)[1])
    batches = make_batches(config, names=("arm",), each=4)
    with pytest.raises(ConfigError, match=r"predictions are not finite \(arm\); did the model diverge"):
        evaluate(broken, config, TABLE, TOKENIZER, batches, EVAL, setting="full")


@pytest.mark.slow
def test_a_model_deaf_to_actions_has_no_delta_psnr(params):
    """Common random numbers: only actions may make a difference."""
    deaf = jax.tree.map(lambda x: x, params)
    deaf["stem"]["out"] = jax.tree.map(jnp.zeros_like, params["stem"]["out"])
    for settings in (EVAL, replace(EVAL, context="recorded")):
        assert run(deaf, settings=settings).summary.overall["delta_psnr"].mean == 0
    assert run(params).summary.datasets["arm"]["delta_psnr"].sem > 0


def test_an_untrained_model_has_the_perplexity_of_the_vocabulary():
    overall = run(declare_model(CONFIG, TABLE).init(0)).summary.overall
    assert overall["perplexity"].mean == pytest.approx(CONFIG.vocab_size, rel=0.02)
    assert overall["perplexity_corpus"].mean <= overall["perplexity"].mean


def test_a_perplexity_is_of_as_many_windows_as_asked_for(params, monkeypatch):
    """Of those windows it is a mean over."""
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    monkeypatch.setattr(
        module,
        "make_evaluator",
        lambda *_: lambda *_: ({"cross_entropy": np.arange(4.0), "finite": np.ones(4, bool)}, None),
    )
    for group, want in ((1, np.exp(np.arange(4.0)).mean()), (2, np.exp([0.5, 2.5]).mean())):
        found = evaluate(params, CONFIG, TABLE, TOKENIZER, [batch], replace(EVAL, perplexity_group=group))
        assert found.summary.datasets["arm"]["perplexity"].mean == pytest.approx(want)


def test_samples_show_true_predicted_and_randomly_driven_clips(params):
    result = run(params)
    (batch, *_) = make_batches(CONFIG)
    clip = result.samples["pusher"]
    assert {k: v.shape for k, v in clip.items()} == dict.fromkeys(
        ("true", "predicted", "random"), (1, CONFIG.frames, SIZE, SIZE, 3)
    )
    np.testing.assert_array_equal(clip["true"][0], batch["images"][0])
    np.testing.assert_array_equal(clip["true"][:, :2], clip["predicted"][:, :2])
    assert (clip["random"] != clip["predicted"]).any(), "random actions change something"
    score = psnr(clip["predicted"][0, 2:], clip["true"][0, 2:]).mean()
    assert score == pytest.approx(result.windows.metrics["psnr"][0], abs=1e-5)
    assert set(result.samples) == {"pusher", "arm"}


def test_after_recorded_frames_every_frame_but_the_first_is_predicted(params):
    recorded, generated = (run(params, settings=replace(EVAL, context=c)) for c in ("recorded", "generated"))
    clip = recorded.samples["arm"]
    assert set(clip) == {"true", "predicted"}
    assert clip["predicted"].shape[1] == CONFIG.frames
    same, other = (e.windows.metrics["cross_entropy"] for e in (recorded, generated))
    np.testing.assert_allclose(same, other, rtol=1e-5)  # the likelihood is that of recorded frames in both
    assert recorded.summary.overall["delta_psnr"].sem > 0
    # Copying shows the image before each.
    images = np.concatenate([batch["images"][batch["valid"]] for batch in make_batches(CONFIG)])
    np.testing.assert_allclose(
        recorded.windows.metrics["psnr_copy"], psnr(images[:, :-1], images[:, 1:]).mean(1), rtol=0, atol=1e-5
    )


@pytest.mark.slow
def test_windows_longer_than_the_model_s_are_continued_past_it(params):
    def judge(batches, settings):
        return evaluate(params, CONFIG, TABLE, TOKENIZER, batches, settings)

    (long,) = make_batches(shallow_config(frames=9), names=("arm",), each=4)
    exact, streamed = (
        judge([long], replace(EVAL, decode=DecodeConfig(1, slide=slide))) for slide in ("exact", "streaming")
    )
    clips = [e.samples["arm"]["predicted"] for e in (exact, streamed)]
    assert clips[0].shape[1] == 9
    np.testing.assert_array_equal(clips[0][:, : CONFIG.frames], clips[1][:, : CONFIG.frames])
    short = {k: v[:, : CONFIG.frames] if k in ("tokens", "actions", "images") else v for k, v in long.items()}
    want = judge([short], EVAL).summary.overall["cross_entropy"].mean
    assert exact.summary.overall["cross_entropy"].mean == pytest.approx(want, rel=1e-6)
    with pytest.raises(ConfigError, match="windows must have the model's 6 frames, got 9"):
        judge([long], replace(EVAL, context="recorded"))


def test_what_cannot_be_evaluated_is_refused(params):
    with pytest.raises(ConfigError, match="leaves no frame to predict"):
        evaluate(params, CONFIG, TABLE, TOKENIZER, [], EvalConfig(prompt_frames=6))
    with pytest.raises(ConfigError, match="the evaluation has no windows"):
        evaluate(params, CONFIG, TABLE, TOKENIZER, [], EVAL)
    (batch,) = make_batches(CONFIG, names=("arm",), each=4)
    with pytest.raises(
        ConfigError, match=r"decodes images of shape \(8, 8, 3\), but the recorded ones have \(7, 8, 3\)"
    ):
        evaluate(params, CONFIG, TABLE, TOKENIZER, [batch | {"images": batch["images"][:, :, 1:]}], EVAL)


@pytest.mark.parametrize("setting", ["forward", "policy"])
def test_models_that_differ_in_the_statistics_of_their_actions_are_evaluated_by_one_program(
    setting, params, monkeypatch
):
    """So that a sweep over how many trajectories there are compiles once, and each is judged by its own statistics."""
    programs, numbers = set(), []

    def noting(_, evaluator, *given):
        programs.add(evaluator.lower(*given).as_text())
        return evaluator

    monkeypatch.setattr(module, "compiled_by_all", noting)
    scaled = EmbodimentTable(
        tuple(replace(e, mean=[m + 0.7 for m in e.mean], std=[2 * s for s in e.std]) for e in TABLE.entries)
    )
    for table in (TABLE, scaled):
        (batch,) = make_batches(CONFIG, names=("arm",), each=4)
        found = evaluate(
            params, CONFIG, table, TOKENIZER, [batch], replace(EVAL, decode=DecodeConfig(1)), setting=setting
        )
        numbers.append(found.windows.metrics["cross_entropy" if setting == "forward" else "action_error_of_mean"])
    assert len(programs) == 1 and (numbers[0] != numbers[1]).all()


# --- Groups, order, memory --------------------------------------------------------------------


def agree(got, want):
    """Tables of the same windows in other programs: equal but for rounding."""
    assert got.names == want.names
    for metric, column in want.metrics.items():
        np.testing.assert_allclose(got.metrics[metric], column, rtol=1e-5, atol=1e-5, err_msg=metric)


def test_a_window_s_numbers_depend_on_neither_batch_nor_row_nor_neighbours(params):
    together = run(params, each=5).windows
    alone = run(params, names=("arm",), each=3).windows
    agree(together.rows(np.asarray([together.names.index(name) for name in alone.names])), alone)


@pytest.mark.slow
def test_how_many_windows_are_in_memory_changes_no_number(params):
    """A batch of 4 in two groups of 2."""
    agree(run(params, execution=ExecutionConfig(windows_at_once=3)).windows, run(params).windows)


@pytest.mark.parametrize(
    ("rows", "at_once", "ways", "plan"),
    [
        (12, 4, 1, (3, 4)), (9, 4, 1, (3, 3)), (5, 8, 1, (1, 5)),
        (5, 8, 4, (1, 8)), (32, 2, 8, (2, 16)), (1, 4, 2, (1, 2)),
    ],
)  # fmt: skip
def test_groups_hold_all_rows_and_few_others(rows, at_once, ways, plan):
    groups, each = plan_groups(rows, at_once, ways)
    assert (groups, each) == plan
    assert each % ways == 0 and each <= at_once * ways and rows <= groups * each < rows + groups * ways


def test_rows_keep_their_order_through_groups():
    batch = {"x": jnp.arange(12), "y": jnp.arange(24.0).reshape(12, 2)}
    seen = in_groups(lambda rows: {"sum": rows["x"] + rows["y"].sum(1)}, batch, groups=3)
    np.testing.assert_array_equal(seen["sum"], batch["x"] + batch["y"].sum(1))


def test_images_decoded_in_pieces_are_those_decoded_together():
    tokens = jnp.arange(7 * 9).reshape(7, 9)
    whole, pieces = (
        decode_in_pieces(GreyTokenizer().decode_uint8_fn, piece, GreyTokenizer.params, tokens) for piece in (64, 3)
    )
    np.testing.assert_array_equal(whole, pieces)
    assert len(np.unique(whole)) == 7


def test_the_next_batch_is_dispatched_before_numbers_are_read(params, monkeypatch):
    events = []

    class Number:
        def __init__(self, value, batch):
            self.value, self.batch = value, batch

        def __array__(self, dtype=None, copy=None):
            events.append(f"read {self.batch}")
            return np.asarray(self.value, dtype)

    def make_logging_evaluator(*args):
        evaluator = make_evaluator(*args)

        def call(*args):
            number = sum("dispatch" in e for e in events)
            events.append(f"dispatch {number}")
            metrics, predicted = evaluator(*args)
            return {name: Number(x, number) for name, x in metrics.items()}, predicted

        return call

    monkeypatch.setattr(module, "make_evaluator", make_logging_evaluator)
    run(params, each=6)
    order = list(dict.fromkeys(events))
    assert order == ["dispatch 0", "dispatch 1", "read 0", "dispatch 2", "read 1", "read 2"]
    assert list(one_ahead([])) == [] and list(one_ahead([5])) == [5]


@pytest.mark.slow
def test_memory_is_that_of_the_windows_at_once_not_of_the_batch(params):
    """Rollouts of all windows together would need a multiple of this."""

    def temporary_bytes(rows, at_once):
        execution, decoder = ExecutionConfig(windows_at_once=at_once), GreyTokenizer(piece=4)
        quick = replace(EVAL, decode=DecodeConfig(1))
        evaluator = make_evaluator(CONFIG, TABLE, quick, "forward", execution, decoder.decode_uint8_fn, decoder.piece)
        (batch,) = make_batches(CONFIG, names=("arm",), batch=rows, each=rows)
        compiled = evaluator.lower(
            params, (decoder.params, None), TABLE.scale(), {k: batch[k] for k in module.REQUIRED_ARRAYS}
        ).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert temporary_bytes(32, 2) < 0.15 * temporary_bytes(32, 32)
