"""Settings changed from the command line: which there are, what is said of others and of values that do not fit."""

from dataclasses import replace

import pytest

from experiments.presets import CPU, SMOKE
from experiments.user_input.override import override
from hma_jax.config import ConfigError


def test_override_sets_nested_fields_and_lists():
    study = override(SMOKE, ["model.frames=3", "widths=4,16", "train.optimizer.learning_rate=1", "seeds=[0,1]",
                             "execution.dtype=bfloat16", "store.frame_step=1", "model.mup.enabled=false",
                             "store.max_skipped=0.01", "train.action_scale=quantiles"])  # fmt: skip
    assert (study.model.frames, study.widths, study.seeds) == (3, (4, 16), (0, 1))
    assert study.train.optimizer.learning_rate == 1.0 and study.store.frame_step == 1
    assert (study.store.max_skipped, study.train.action_scale) == (0.01, "quantiles")
    assert study.execution.dtype == "bfloat16" and study.model.mup.enabled is False


def test_of_several_values_the_last_is_taken_whichever_kinds_of_number_they_are():
    assert override(SMOKE, ["tau=1000", "tau=2.5"]).tau == 2.5
    assert override(replace(SMOKE, rate=None), ["rate=4", "rate=2.5"]).rate == 2.5
    with pytest.raises(ConfigError, match="train.steps=2.5: expected a value like"):
        override(SMOKE, ["train.steps=7", "train.steps=2.5"])
    latents = ["tokenizer.quantise=false", 'model.diffusion={"channels": 2, "patch": 1}', "model.diffusion.patch=2"]
    assert override(SMOKE, latents).model.diffusion.patch == 2


def test_lists_of_names_are_written_without_quotes_wherever_they_are():
    study = override(SMOKE, ["train.only=arm_sky,arm_plum", "model.mup.without=init", "unseen=arm_sand", "axes=width"])
    assert (study.train.only, study.model.mup.without) == (("arm_sky", "arm_plum"), ("init",))
    assert (study.unseen, study.axes) == (("arm_sand",), ("width",))
    assert override(study, ["train.only="]).train.only == ()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("model.frame=4", "did you mean model.frames"),
        ("model.frames", "path=value"),
        ("model.frames=many", r"model.frames=many: expected a value like \d+$"),
        ("model.frames=2.5", "expected a value like"),
        ("train.steps=1e4", "expected a whole number, written 10000"),
        ("model.mup.enabled=3", "expected a value like"),
        ("eval.prompt_frames=4", "leaves nothing to predict"),
        ("model.tokens=9", "the tokenizer makes 16"),
        ("model=4", "this is a group of settings"),
        ("tau.x=4", "tau is a value, 3.0"),
        ("model.diffusion.width=4", "model.diffusion is null in this study"),
        ("trajectory_counts=8,4", "must increase"),
        ("train.optimizer.schedule=linear", "train.optimizer.schedule: 'linear'.*constant, cosine, wsd"),
        ("store.max_skipped=1.5", "store.max_skipped must be a whole number of episodes or, below 1, a fraction"),
        ("train.action_scale=best", "train.action_scale: 'best'.*deviation, quantiles"),
        ("store.corrupt=ignore", "store.corrupt: 'ignore'.*raise, skip"),
        ("model.frames=null", "model.frames: expected int, got None"),
        ("widths=4,8.5", "widths: expected int, got 8.5"),
        ("ablation_seeds=2,1", "ablation_seeds must increase"),
        ("tau=0", "tau must be positive, got 0"),
        ("rate=Infinity", "rate, in frames per second, must be positive and finite, .* got inf"),
        ("suite.scale=Infinity", "suite.scale must be positive and finite, got inf"),
        ("store.val_fraction=1", r"store.val_fraction must lie in \[0, 1\), got 1"),
        ("store.max_val=1", "store.min_val must lie between 0 and store.max_val, 1, got "),
        ("store.max_val_fraction=0", "store.max_val_fraction must lie in"),
        ("store.max_val_fraction=0.51", r"store.max_val_fraction must lie in \(0, 0.5\], got 0.51"),
        ("store.frame_step=0", "store.frame_step must be at least 1, got 0"),
        ("store.max_skipped=Infinity", "store.max_skipped must be a whole number .* got inf"),
        ("flops_per_second=0", "flops_per_second must be positive"),
        ("trial_seconds=-1", "trial_seconds must not be negative"),
        ("designs.rate_factors=2,1", "designs.rate_factors must increase and be positive"),
        ("widths=a,b", "widths=a: expected numbers separated by commas$"),
        # What training would refuse, once data and tokenizer are made.
        ("train.masking.setting=full", "has no action heads; set model.action_heads=true"),
        ("execution.accumulate=3", "train.batch 4 is not a multiple of execution.accumulate 3"),
    ],
)
def test_wrong_override_names_the_field(setting, message):
    with pytest.raises(ConfigError, match=message):
        override(SMOKE, [setting])


def test_a_prompt_may_fill_the_window_of_a_policy():
    policy = ["model.action_heads=true", "train.masking.setting=policy"]
    assert override(SMOKE, [*policy, "eval.prompt_frames=4"]).eval.prompt_frames == SMOKE.model.frames
    with pytest.raises(ConfigError, match="eval.prompt_frames 5 leaves nothing to predict"):
        override(SMOKE, [*policy, "eval.prompt_frames=5"])


@pytest.mark.parametrize(
    ("path", "meant"),
    [
        ("learning_rate", ["train.optimizer.learning_rate", "tokenizer_train.learning_rate"]),
        ("train.learning_rate", ["train.optimizer.learning_rate"]),
        ("optimizer.learning_rate", ["train.optimizer.learning_rate"]),
        ("tokeniser.bits", ["tokenizer.bits"]),
        ("tokenizer_trian.steps", ["tokenizer_train.steps"]),
        ("transfer.width", ["transfer.widths", "model.width"]),
        ("frame", ["model.frames"]),
        ("mesh.data", ["execution.mesh.data"]),
        ("lr", ["train.optimizer.learning_rate", "tokenizer_train.learning_rate"]),
        ("train.lr", ["train.optimizer.learning_rate"]),
        ("batch_size", ["train.batch", "eval.batch", "tokenizer_train.batch"]),
        ("train.num_steps", ["train.steps"]),
        ("seed", ["seeds", "eval.seed", "tokenizer_train.seed", "suite.seed"]),
    ],
)
def test_unknown_setting_suggests_what_was_meant(path, meant):
    with pytest.raises(ConfigError, match=f"did you mean {' or '.join(meant)}\\?$"):
        override(SMOKE, [f"{path}=1"])


@pytest.mark.parametrize(
    ("path", "around"), [("foo", "a study has name, model.*,"), ("train.epochs", "train has steps,")]
)
def test_unknown_setting_like_no_other_lists_those_around_it_only(path, around):
    with pytest.raises(ConfigError) as refusal:
        override(CPU, [f"{path}=1"])
    assert around in str(refusal.value) and str(refusal.value).count(", ") < 25
