"""Configurations that cannot work are refused when they are made."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from typing import Literal

import numpy as np
import pytest

from hma_jax import config
from hma_jax.config import (
    ConfigError,
    DecodeConfig,
    DiffusionConfig,
    EvalConfig,
    ExecutionConfig,
    Magvit2Config,
    MaskingConfig,
    MeshConfig,
    ModelConfig,
    MupConfig,
    OptimizerConfig,
    PythonConfig,
    SamplerConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
    TrainConfig,
)
from hma_jax.config.base import check_fields, later
from hma_jax.config.json import diff, from_dict, identity_of, stable_hash, to_dict, to_strict_json
from hma_jax.model.embodiments import Embodiment

ARM = {"name": "arm", "action_dim": 1, "stride": 1, "mean": (0.0,), "std": (1.0,)}
CONFIGS = [found for found in map(config.__dict__.get, config.__all__) if dataclasses.is_dataclass(found)]


def test_every_field_with_choices_is_compared_with_them():
    fields = [
        (cls, name, hint)
        for cls in CONFIGS
        for name, hint in typing.get_type_hints(cls).items()
        if "Literal" in repr(hint)
    ]
    assert {cls for cls, _, _ in fields} >= {MaskingConfig, MupConfig, ModelConfig, Magvit2Config, ExecutionConfig}
    for cls, name, hint in fields:
        wrong = ("misspelt",) if typing.get_origin(hint) is tuple else "misspelt"
        with pytest.raises(ConfigError, match=rf"^{cls.__name__}\.{name}: 'misspelt' is not allowed; choose one of \w"):
            cls(**{name: wrong})


def test_choices_are_found_in_a_type_beside_none_and_in_tuples():
    @dataclasses.dataclass
    class Some:
        one: Literal["a", "b"] | None = None
        several: tuple[Literal[1, 2], ...] = ()
        whatever: str | None = None
        anything: typing.Any | None = None

    for accepted in (Some(), Some("a", (1, 2, 1), "c", object())):
        check_fields(accepted)
    with pytest.raises(ConfigError, match="Some.one: 'c' is not allowed; choose one of a, b, None"):
        check_fields(Some("c"))
    with pytest.raises(ConfigError, match="Some.several: 3 is not allowed; choose one of 1, 2"):
        check_fields(Some(several=(1, 3)))


MADE = [PythonConfig(vocab_size=2) if cls is PythonConfig else cls() for cls in CONFIGS] + [Embodiment(**ARM)]
SCALARS = [
    (made, f.name, f.type) for made in MADE for f in dataclasses.fields(made) if f.type in ("bool", "int", "float")
]


def test_numbers_are_pythons_whichever_way_they_are_written():
    """A run with warmup_steps=1e3 was trained and saved, and then refused whenever it was read."""
    assert {kind for _, _, kind in SCALARS} == {"bool", "int", "float"} and len(SCALARS) > 100
    as_good = {"bool": (np.bool_,), "int": (np.int64, np.uint32, float, np.float32), "float": (np.float64, np.array)}
    for made, name, kind in SCALARS:
        value = getattr(made, name)
        for write in as_good[kind]:
            if write is np.uint32 and value < 0:
                continue
            again = dataclasses.replace(made, **{name: write(value)})
            assert again == made and type(getattr(again, name)) is type(value)
            assert from_dict(type(made), json.loads(json.dumps(to_dict(again)))) == made


def test_values_of_another_type_are_refused_when_a_configuration_is_made():
    """Each was accepted, and ended in an error that named no field, or in a run that could not be read."""
    wrong = {"bool": (1, 0.0, "true", None), "int": (2.5, True, "2", None, [2]), "float": (True, "0.1", None, 10**400)}
    for made, name, kind in SCALARS:
        for value in wrong[kind]:
            with pytest.raises(
                ConfigError, match=rf"^{type(made).__name__}\.{name}: (expected {kind}|the number is too)"
            ):
                dataclasses.replace(made, **{name: value})
    for cls, values, message in (
        (TrainConfig, {"optimizer": {"learning_rate": 0.1}}, r"optimizer: expected OptimizerConfig, got \{"),
        (TrainConfig, {"only": "arm"}, "only: expected a list, got 'arm'"),
        (TrainConfig, {"only": (1,)}, "only: expected str, got 1"),
        (ModelConfig, {"diffusion": MupConfig()}, "diffusion: expected DiffusionConfig, got MupConfig"),
        (Magvit2Config, {"image_size": None}, "image_size: expected int, got None"),
        (Magvit2Config, {"image_size": (64, 64, 3)}, r"image_size: expected 2 values, got \(64, 64, 3\)"),
    ):
        with pytest.raises(ConfigError, match=f"^{cls.__name__}.{message}"):
            cls(**values)
    assert Magvit2Config(image_size=[64.0, np.int64(128)]).image_size == (64, 128)


def test_a_whole_number_for_a_float_makes_the_same_name_as_the_float():
    """The two are equal, and a file that is read always gives the float."""
    assert json.dumps(to_dict(MupConfig(attention_scale=8))["attention_scale"]) == "8.0"
    assert stable_hash(MupConfig(attention_scale=8)) == stable_hash(MupConfig(attention_scale=8.0))


def test_a_whole_number_that_was_written_as_a_float_is_read():
    read = from_dict(OptimizerConfig, {"warmup_steps": 1000.0})
    assert json.dumps(to_dict(read)["warmup_steps"]) == "1000"
    with pytest.raises(ConfigError, match="OptimizerConfig.warmup_steps: expected int, got 2.5"):
        from_dict(OptimizerConfig, {"warmup_steps": 2.5})


@pytest.mark.parametrize(
    ("cls", "values", "message"),
    [
        (ModelConfig, {"heads": 0}, "model.heads must be at least 1, got 0"),
        (ModelConfig, {"mlp_ratio": 0.0}, "model.mlp_ratio 0.0 makes the MLP of model.width 256 less than 1 wide"),
        (ModelConfig, {"mlp_ratio": -1.0}, "model.mlp_ratio -1.0"),
        (ModelConfig, {"trunk_gain": 0.0}, "model.trunk_gain must be positive, got 0.0"),
        (ModelConfig, {"stem_gain": -1.0}, "model.stem_gain must be positive, got -1.0"),
        (
            ModelConfig,
            {"factors": 4},
            "model.factors 4 with model.factor_vocab 512 give more than 2147483648 ids",
        ),
        (ModelConfig, {"factors": 10**9}, "model.factors 1000000000 with model.factor_vocab 512"),
        (MupConfig, {"base_width": 0}, "mup.base_width must be at least 1, got 0"),
        (MupConfig, {"attention_scale": 0.0}, "mup.attention_scale must be positive, got 0.0"),
        (DiffusionConfig, {"steps": 1}, "diffusion.steps must be at least 2, got 1"),
        (DiffusionConfig, {"noise_shift": -1.0}, "diffusion.noise_shift must be positive, got -1.0"),
        (DiffusionConfig, {"time_shift": 0.0}, "diffusion.time_shift must be positive, got 0.0"),
        (DiffusionConfig, {"weight_cap": -1.0}, "diffusion.weight_cap must not be negative, got -1.0"),
        (DiffusionConfig, {"clip": 0.0}, "diffusion.clip must be positive, got 0.0"),
        (SamplerConfig, {"steps": 1}, "sampler.steps must be at least 2, got 1"),
        (SamplerConfig, {"temperature": -1.0}, "sampler.temperature must not be negative, got -1.0"),
        (DecodeConfig, {"temperature": -1.0, "sampler": SamplerConfig()}, "decode.temperature must not be negative"),
        (DecodeConfig, {"top_k": -1}, "decode.top_k must not be negative, got -1"),
        (DecodeConfig, {"unmask_steps": 0}, "decode.unmask_steps must be at least 1, got 0"),
        (OptimizerConfig, {"learning_rate": -1.0}, "optimizer.learning_rate must be positive, got -1.0"),
        (OptimizerConfig, {"warmup_steps": -1}, "optimizer.warmup_steps must not be negative"),
        (OptimizerConfig, {"clip_norm": -1.0}, "optimizer.clip_norm must be positive, got -1.0"),
        (OptimizerConfig, {"beta1": 1.0}, r"optimizer.beta1 must lie in \[0, 1\), got 1.0"),
        (OptimizerConfig, {"beta2": 1.5}, r"optimizer.beta2 must lie in \[0, 1\), got 1.5"),
        (OptimizerConfig, {"final_fraction": 5.0}, r"optimizer.final_fraction must lie in \[0, 1\], got 5.0"),
        (OptimizerConfig, {"decay_fraction": 2.0}, r"optimizer.decay_fraction must lie in \[0, 1\], got 2.0"),
        (
            OptimizerConfig,
            {"decay_fraction": 0.0, "schedule": "wsd"},
            "optimizer.decay_fraction is 0, so schedule wsd",
        ),
        (OptimizerConfig, {"epsilon": 0.0}, "optimizer.epsilon must be positive, got 0.0"),
        (OptimizerConfig, {"weight_decay": -1.0}, "optimizer.weight_decay must not be negative, got -1.0"),
        (TokenizerConfig, {"image_size": 0}, "tokenizer.image_size 0 is not a multiple of downsample 8"),
        (TokenizerConfig, {"image_size": -8}, "tokenizer.image_size -8 is not a multiple of downsample 8"),
        (TokenizerTrainConfig, {"weight_decay": -1.0}, "weight_decay must not be negative, got -1.0"),
        (TokenizerTrainConfig, {"final_fraction": 5.0}, r"final_fraction must lie in \[0, 1\], got 5.0"),
        (TokenizerTrainConfig, {"seed": -1}, r"tokenizer training: seed must lie in \[0, 2\^32\), got -1"),
        (
            TrainConfig,
            {"seed": 2**32},
            r"train.seed must lie in \[0, 2\^32\), got 4294967296",
        ),  # its masks are those of 0
        (TrainConfig, {"batch": 0}, "train.batch must be at least 1, got 0"),
        (EvalConfig, {"seed": 2**64}, r"eval.seed must lie in \[0, 2\^32\)"),
        (ExecutionConfig, {"loader_threads": 10**6}, "execution.loader_threads must be at most 1,024, got 1,000,000"),
        (EvalConfig, {"batch": 0}, "eval.batch must be at least 1, got 0"),
        (EvalConfig, {"prompt_frames": 0}, "eval.prompt_frames must be at least 1"),
        (EvalConfig, {"random_actions": 0}, "eval.random_actions must be at least 1"),
        (EvalConfig, {"other_actions": -1}, "eval.other_actions must not be negative"),
        (EvalConfig, {"windows_per_dataset": 0}, "eval.windows_per_dataset must be at least 1"),
        (EvalConfig, {"perplexity_group": 0}, "eval.perplexity_group must be at least 1, got 0"),
        (Embodiment, ARM | {"std": (-1.0,)}, r"embodiment 'arm': std must not be negative, got \(-1.0,\)"),
        (Embodiment, ARM | {"mean": (math.nan,)}, "embodiment 'arm': action statistics are not finite"),
        (MeshConfig, {"min_shard_size": -1}, "mesh.min_shard_size must not be negative, got -1"),
        (MaskingConfig, {"prompt_frames": 0}, "masking.prompt_frames must be at least 1, got 0"),
        (MaskingConfig, {"label_smoothing": 1.0}, "masking.label_smoothing must be below 1"),
        (
            MaskingConfig,
            {"setting": "policy", "action_loss_weight": 0.0},
            "'policy' predicts only actions, so nothing would",
        ),
        (MaskingConfig, {"mask_angle_min": 1.0}, "masking.mask_angle_min 1 masks no token"),
    ],
)
def test_numbers_that_cannot_work_are_refused(cls, values, message):
    with pytest.raises(ConfigError, match=message):
        cls(**values)


LIMITS = {
    (OptimizerConfig, "clip_norm"), (TokenizerTrainConfig, "clip_norm"),
    (DiffusionConfig, "clip"), (DiffusionConfig, "weight_cap"),
}  # fmt: skip
"""Fields that infinity switches off."""


def test_no_number_of_a_configuration_is_infinite_or_none_at_all():
    """Among them are some that ended in an OverflowError, as model.mlp_ratio=inf, and many in a loss of NaN."""
    fields = {(cls, f.name) for cls in CONFIGS for f in dataclasses.fields(cls) if f.type == "float"}
    assert len(fields) > 30 and fields > LIMITS
    for cls, name in fields:
        for value in (math.inf, -math.inf, math.nan):
            if value == math.inf and (cls, name) in LIMITS:
                cls(**{name: value})
                continue
            with pytest.raises(ConfigError, match=rf"^{cls.__name__}\.{name} must be finite, got {value}"):
                cls(**{name: value})


def test_whole_numbers_that_no_float_or_array_holds_are_refused():
    assert from_dict(OptimizerConfig, {"learning_rate": 1}).learning_rate == 1.0
    with pytest.raises(ConfigError, match="OptimizerConfig.learning_rate: the number is too large for float"):
        from_dict(OptimizerConfig, {"learning_rate": 10**400})
    for steps in (1e300, -(10**30)):
        with pytest.raises(ConfigError, match="TrainConfig.steps: the number is too large for int"):
            from_dict(TrainConfig, {"steps": steps})


def test_lists_are_as_good_as_tuples():
    """`train_model` ended in "unhashable type"."""
    for cls, name, value in ((TrainConfig, "only", ["arm"]), (MupConfig, "without", ["init", "readout"])):
        written, meant = (cls(**{name: kind(value)}) for kind in (list, tuple))
        assert written == meant and hash(written) == hash(meant)
    with pytest.raises(ConfigError, match="MupConfig.without: 'int' is not allowed"):
        MupConfig(without=["int"])


def test_the_statistics_of_a_single_action_value_may_be_numbers():
    assert Embodiment("x", 1, 1, np.float32(0.5), 2).mean == Embodiment("x", 1, 1, [0.5], [2]).mean == (0.5,)


def test_limits_that_can_work_are_accepted():
    OptimizerConfig(beta1=0.0, final_fraction=0.0, decay_fraction=1.0, weight_decay=0.0)
    OptimizerConfig(schedule="cosine", decay_fraction=0.0)
    ModelConfig(factors=31, factor_vocab=2)  # as many ids as an int32 has
    ModelConfig(factors=9, diffusion=DiffusionConfig())  # of latents, which have none
    MaskingConfig(mask_angle_min=1.0, min_ratio=0.5)  # half of every frame
    MeshConfig(min_shard_size=0)


@dataclasses.dataclass(frozen=True)
class Inner:
    first: int = 1
    added: tuple[int, ...] = later(())


@dataclasses.dataclass(frozen=True)
class Outer:
    first: float = 1.0
    inner: Inner = Inner()
    added: float = later(0.5, before=0.0)


def test_a_field_that_came_later_is_part_of_no_name_with_the_value_from_before():
    before = {"first": 1.0, "inner": {"first": 1}}
    assert identity_of([Outer(added=0.0)]) == [before]
    assert identity_of(Outer(added=0.0, inner=Inner(added=[]))) == before  # a list is as good as a tuple
    assert identity_of(Outer()) == before | {"added": 0.5}
    assert identity_of({"a": Outer(added=0.0, inner=Inner(added=(2,)))}) == {
        "a": before | {"inner": {"first": 1, "added": [2]}}
    }
    assert stable_hash(["x", Outer(added=0.0)]) == stable_hash(["x", before]) != stable_hash(["x", Outer()])
    assert to_dict(Outer(added=0.0)) == {"first": 1.0, "inner": {"first": 1, "added": []}, "added": 0.0}


def test_what_was_written_before_a_field_was_there_has_its_value_from_before():
    assert from_dict(Outer, {"first": 2.0, "inner": {"first": 3}}) == Outer(2.0, Inner(3), added=0.0)
    for one in (Outer(), Outer(added=0.0), Outer(inner=Inner(added=(4,)))):
        assert from_dict(Outer, identity_of(one)) == from_dict(Outer, to_dict(one)) == one


def test_files_for_other_programs_hold_no_number_that_json_does_not_have():
    text = to_strict_json({"mean": 1.5, "sem": math.nan, "errors": [math.inf, -math.inf]})
    assert json.loads(text, parse_constant=pytest.fail) == {"mean": 1.5, "sem": None, "errors": [None, None]}


def test_robots_that_differ_are_named_and_not_written_out():
    arm, base = ({"name": name, "stride": 3, "mean": [0.1] * 26} for name in ("arm", "base"))

    def told(here):
        return diff({"entries": [arm, base]}, {"entries": here}, "table")

    assert told([arm]) == ["table.entries: ['arm', 'base'] -> ['arm']"]
    assert told([base, arm]) == ["table.entries: ['arm', 'base'] -> ['base', 'arm']"]
    assert told([arm, base | {"stride": 2}]) == ["table.entries.base.stride: 3 -> 2"]
    assert told([arm, dict(base)]) == []
    assert told([arm, arm]) != [] and told([]) != []
