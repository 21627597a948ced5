"""Official checkpoints: what goes through us comes back as it was, and what does not fit is named."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import ml_dtypes
import numpy as np
import pytest
from safetensors import safe_open

from hma_jax.config import ConfigError, EvalConfig
from hma_jax.convert import (
    import_remarks,
    loads_in_release,
    official_shapes,
    read_neutral,
    read_official,
    write_neutral,
    write_official,
)
from hma_jax.convert.official import official_config as written_config
from hma_jax.convert.official_config import NETWORKS, read_masking
from hma_jax.convert.table import flat, official_parts
from hma_jax.convert.tensors import read_safetensors, write_safetensors
from hma_jax.evaluation.protocol import make_predictor
from hma_jax.model.hma import declare_model
from hma_jax.training.runs import Run
from tests.hma_jax.convert.fakes import (
    CONTINUOUS,
    DISCRETE,
    make_checkpoint,
    official_config,
    random_tensors,
    write_checkpoint,
)
from tests.tiny import TABLE, model_config

ONE = [("push", 2, 1)]
TWO = [("1x_humanoid", 7, 2), ("push", 2, 1)]
FORTY = [(f"robot_{n}", n % 9 + 1, n % 5 + 1) for n in range(40)]


def same_files(a: Path, b: Path) -> None:
    before, after = (read_safetensors(x / "model.safetensors") for x in (a, b))
    assert before.keys() == after.keys()
    for name, tensor in before.items():
        assert (tensor.shape, tensor.dtype) == (after[name].shape, after[name].dtype), name
        assert tensor.read().tobytes() == after[name].read().tobytes(), name
    contents = [json.loads((x / "config.json").read_text()) for x in (a, b)]
    assert contents[0] == contents[1]


@pytest.mark.parametrize("robots", [ONE, TWO, FORTY], ids=["1", "2", "40"])
@pytest.mark.parametrize("base", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_there_and_back_is_byte_identical(base, robots, tmp_path):
    start = make_checkpoint(tmp_path / "a", base, robots)
    run = read_official(start)
    assert run.table.names == tuple(name for name, _, _ in robots)
    assert [(e.action_dim, e.stride) for e in run.table.entries] == [(dim, stride) for _, dim, stride in robots]
    remarks = write_official(run, tmp_path / "b")
    same_files(start, tmp_path / "b")
    loads = loads_in_release(json.loads((tmp_path / "b" / "config.json").read_text()))
    assert loads == (base is DISCRETE) == (not remarks)


@pytest.mark.parametrize(
    "changes",
    [
        {"action_network": "mlp"},
        {"action_network": "modulate", "qkv_bias": True},
        {"action_network": "concat", "proj_bias": False, "mlp_bias": False},
        {"action_network": "cross_attention", "qk_norm": True},
        {"use_mup": False, "image_vocab_size": 512, "num_factored_vocabs": 3, "factored_vocab_size": 999},
    ],
    ids=str,
)
def test_every_switch_of_the_release_goes_there_and_back(changes, tmp_path):
    start = make_checkpoint(tmp_path / "a", DISCRETE, TWO, **changes)
    write_official(read_official(start), tmp_path / "b")
    same_files(start, tmp_path / "b")


def test_half_precision_comes_back_as_it_was(tmp_path):
    config = official_config(DISCRETE, ONE)
    tensors = random_tensors(config, ONE)
    tensors["out_x_proj.weight"] = tensors["out_x_proj.weight"].astype(np.float16)
    tensors["pos_embed_TSC"] = tensors["pos_embed_TSC"].astype(ml_dtypes.bfloat16)
    start = write_checkpoint(tmp_path / "a", config, tensors)
    run = read_official(start)
    assert {x.dtype for x in flat(run.params).values()} == {np.dtype(np.float32)}
    write_official(run, tmp_path / "b")
    same_files(start, tmp_path / "b")


def test_a_trained_run_keeps_fields_we_have_no_use_for_and_says_what_changed(tmp_path):
    start = make_checkpoint(tmp_path / "a", DISCRETE, ONE)
    run = read_official(start)
    trained = replace(run, train=replace(run.train, masking=replace(run.train.masking, non_mlm_ratio=0.5)))
    for _ in range(2):  # what `hma train --from` and `hma adapt` leave of a provenance
        trained = replace(
            trained, step=5, provenance={"store": "s", "origin": {"step": 0, "provenance": trained.provenance}}
        )
    write_official(trained, tmp_path / "b")
    before, after = (json.loads((tmp_path / x / "config.json").read_text()) for x in "ab")
    assert after == before | {"non_mlm_ratio": 0.5, "factored_vocab_size": 8}


@pytest.mark.parametrize("setting", ["forward", "full", "policy"])
def test_what_a_model_predicts_goes_there_and_back(setting, tmp_path):
    """A model of actions only must not come back as one that can be asked for frames."""
    run = read_official(make_checkpoint(tmp_path / "a", DISCRETE, ONE))
    trained = replace(run, step=1, train=replace(run.train, masking=replace(run.train.masking, setting=setting)))
    write_official(trained, tmp_path / "b")
    assert read_official(tmp_path / "b").train.masking.setting == setting


@pytest.mark.parametrize(
    ("base", "changes", "said"),
    [
        (DISCRETE, {}, None),
        (DISCRETE, {"action_network": "cross_attention"}, "cross-attention is computed as the paper"),
        (DISCRETE, {"jointly_predict_actions": True}, "actions that it predicts are wrong"),
        (DISCRETE, {"jointly_predict_actions": True, "action_network": "mlp"}, "actions that it predicts are ignored"),
        (CONTINUOUS, {"use_mup": False}, None),
        (CONTINUOUS, {"use_mup": False, "jointly_predict_actions": True}, "actions that it predicts are wrong"),
        (CONTINUOUS, {}, "width is 16.* multiplied by 1 here"),
        (CONTINUOUS, {"d_model": 256}, None),
        (CONTINUOUS, {"use_mup": False, "num_sampling_steps": "25"}, "num_sampling_steps is '25': .*sampler.steps=25$"),
    ],
    ids=str,
)
def test_what_an_imported_model_may_compute_otherwise_is_said(base, changes, said, tmp_path):
    remarks = import_remarks(read_official(make_checkpoint(tmp_path / "a", base, ONE, **changes)))
    assert len(remarks) == (said is not None) and (said is None or re.search(said, remarks[0]))


def test_constant_actions_that_the_release_shows_its_model_are_named(tmp_path):
    """Of 0.3, in 1,000 rows, it stores the mean 0.30000007 and the deviation 6e-8: the model was shown -1."""
    config = official_config(DISCRETE, TWO)
    tensors = random_tensors(config, TWO)
    tensors["action_preprocessor.1x_humanoid.std"][[0, 2, 5]] = 6e-8, 1e-7, 0
    (remark,) = import_remarks(read_official(write_checkpoint(tmp_path / "a", config, tensors)))
    assert "deviation is at most 1e-06 are 0 here: 1x_humanoid (0, 2). " in remark


@pytest.mark.parametrize("network", NETWORKS)
def test_an_imported_model_of_frames_and_actions_can_be_judged(network, tmp_path):
    """Without action tokens its frames, as there is nothing to read actions from."""
    run = read_official(
        make_checkpoint(tmp_path / "a", DISCRETE, ONE, action_network=network, jointly_predict_actions=True)
    )
    config, frames = EvalConfig(prompt_frames=1), run.model.frames
    predict = make_predictor(run.model, run.table, config, run.train.masking.setting)
    batch = {
        "tokens": np.zeros((2, frames, run.model.tokens), np.int32),
        "actions": np.zeros((2, frames, run.table.action_width), np.float32),
        **{name: np.zeros(2, np.int32) for name in ("embodiment", "episode", "start")},
    }
    metrics, predicted = jax.eval_shape(predict, run.params, batch)
    assert ("action_error" in metrics) == ("concat" in network) and predicted.tokens.shape[1] == frames - 1


def test_weights_that_were_changed_in_another_format_do_not_count_as_they_came(tmp_path):
    """`_without_constants` is for what this project made: here of a value that never varies."""
    config = official_config(DISCRETE, ONE)
    tensors = random_tensors(config, ONE)
    tensors["action_preprocessor.push.std"][1] = 0
    run = read_official(write_checkpoint(tmp_path / "a", config, tensors))

    def constant_of(run: Run, name: str) -> np.ndarray:
        write_neutral(run, tmp_path / f"{name}.ours")
        write_official(read_neutral(tmp_path / f"{name}.ours"), tmp_path / name)
        return read_safetensors(tmp_path / name / "model.safetensors")["action_mlp.push.model.0.weight"].read()[:, 1]

    assert constant_of(run, "as it came").all()
    biases = {"linear": {**run.params["frame_head"]["linear"], "bias": run.params["frame_head"]["linear"]["bias"] + 1}}
    assert not constant_of(replace(run, params={**run.params, "frame_head": biases}), "changed").any()


@pytest.mark.parametrize("corrupted", [False, True])
@pytest.mark.parametrize("rate", [0.0, 0.1])
def test_how_ids_were_corrupted_in_further_training_is_written(corrupted: bool, rate: float, tmp_path):
    """The imported file's word that they are not was kept."""
    run = read_official(make_checkpoint(tmp_path / "a", DISCRETE, ONE, dataloader_apply_corruption=corrupted))
    assert bool(run.train.masking.max_corrupt_rate) == corrupted
    masking = replace(run.train.masking, max_corrupt_rate=rate)
    further = replace(run, train=replace(run.train, masking=masking))
    assert read_masking(written_config(further)) == masking


@pytest.mark.parametrize("base", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_missing_extra_and_misshapen_tensors_are_all_named(base, tmp_path):
    config = official_config(base, TWO)
    tensors = random_tensors(config, TWO)
    del tensors["decoder.layers.1.mlp.fc1.weight"]
    tensors["surprise.weight"] = np.zeros((2, 2), np.float32)
    tensors["action_mlp.push.model.0.weight"] = np.zeros((16, 5), np.float32)
    with pytest.raises(ConfigError) as caught:
        read_official(write_checkpoint(tmp_path / "a", config, tensors))
    said = str(caught.value)
    assert "1 missing: decoder.layers.1.mlp.fc1.weight (64, 16)" in said
    assert "1 not expected: surprise.weight (2, 2)" in said
    assert "action_mlp.push.model.0.weight: expected (16, 2), found (16, 5)" in said


def test_tensors_that_are_not_finite_are_refused_by_name(tmp_path):
    config = official_config(DISCRETE, ONE)
    for name in ("out_x_proj.bias", "action_preprocessor.push.mean"):
        tensors = random_tensors(config, ONE)
        tensors[name][1] = np.inf
        halves = {key: x.astype(ml_dtypes.bfloat16) for key, x in tensors.items()}
        for kind, written in (("floats", tensors), ("halves", halves)):
            folder = tmp_path / f"{name} {kind}"
            with pytest.raises(ConfigError, match=f"^{folder}: {name} contains values that are not finite"):
                read_official(write_checkpoint(folder, config, written))


def test_a_checkpoint_in_several_files_is_read_by_its_index(tmp_path):
    whole = make_checkpoint(tmp_path / "whole", DISCRETE, ONE)
    tensors = {name: x.read() for name, x in read_safetensors(whole / "model.safetensors").items()}
    files = {name: f"model-0000{n % 2 + 1}-of-00002.safetensors" for n, name in enumerate(tensors)}
    folder = tmp_path / "several"
    folder.mkdir()
    shutil.copy(whole / "config.json", folder)
    for file in set(files.values()):
        write_safetensors(folder / file, {name: x for name, x in tensors.items() if files[name] == file})
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"metadata": {}, "weight_map": files}))
    write_official(read_official(folder), tmp_path / "back")
    same_files(whole, tmp_path / "back")
    (folder / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(ConfigError, match="several: missing model-00002-of-00002.safetensors, which model.*index.json"):
        read_official(folder)
    index.write_text("{}")
    with pytest.raises(ConfigError, match="index.json is not a readable index of weight files"):
        read_official(folder)


@pytest.mark.parametrize("prefix", ["module.", "_orig_mod.", "module._orig_mod."])
def test_what_torch_puts_before_all_names_is_taken_off(prefix, tmp_path):
    config = official_config(DISCRETE, ONE)
    tensors = random_tensors(config, ONE)
    before = read_official(write_checkpoint(tmp_path / "plain", config, tensors))
    wrapped = {prefix + name: x for name, x in tensors.items()}
    after = read_official(write_checkpoint(tmp_path / "wrapped", config, wrapped))
    assert after.provenance == before.provenance  # it has a hash of the weights


def test_who_gives_a_name_of_the_hub_or_its_cache_is_told_what_to_give(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="hf download liruiw/hma-base-disc --local-dir hma-base-disc"):
        read_official(Path("liruiw/hma-base-disc"))
    (tmp_path / "models--liruiw--hma-base-disc" / "snapshots").mkdir(parents=True)
    with pytest.raises(
        ConfigError, match="give the directory of a version in .*models--liruiw--hma-base-disc/snapshots"
    ):
        read_official(tmp_path / "models--liruiw--hma-base-disc")


def test_files_say_that_they_are_pytorch_s(tmp_path):
    """transformers and accelerate ask for it."""
    start = make_checkpoint(tmp_path / "a", DISCRETE, ONE)
    write_official(read_official(start), tmp_path / "b")
    with safe_open(tmp_path / "b" / "model.safetensors", framework="np") as file:
        assert file.metadata() == {"format": "pt"}
    assert (tmp_path / "b" / "model.safetensors").read_bytes() == (start / "model.safetensors").read_bytes()


def test_many_wrong_tensors_are_counted_and_ten_are_shown(tmp_path):
    config = official_config(DISCRETE, ONE)
    tensors = {name: x for name, x in random_tensors(config, ONE).items() if not name.startswith("decoder")}
    with pytest.raises(ConfigError) as caught:
        read_official(write_checkpoint(tmp_path / "a", config, tensors))
    assert str(caught.value).count("decoder.layers") == 10 and "40 missing" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_network": "resampler_concat"}, "action_network 'resampler_concat' is not supported.*mlp"),
        ({"action_network": ["mlp"]}, "action_network .'mlp'. is not supported"),
        ({"d_model": None}, "missing field.*d_model"),
        ({"num_heads": 3}, "multiple of model.heads"),
        ({"image_vocab_size": 65}, "65 cannot be split into 2 equal factors"),
        ({"T": "three"}, "frames: expected int, got 'three'"),
        ({"d_actions": [3]}, "1 action_domains but|d_actions 3 of push is not a multiple of its 2"),
        ({"action_domains": None}, "missing field.*action_domains"),
        ({"action_domains": None, "d_actions": None}, "null: action_domains, d_actions: a model without robots"),
        ({"use_actions": False}, "use_actions is false: the release trains such a model without actions"),
        ({"d_actions": ["2"]}, "d_actions must list one value per robot"),
        ({"S": None}, "S must be a positive integer, got None"),
        ({"num_prompt_frames": 0}, "prompt_frames must be at least 1"),
        ({"jointly_predict_states": False}, "jointly_predict_states and jointly_predict_actions are both false"),
        (
            {"jointly_predict_states": False, "jointly_predict_actions": True, "action_network": "modulate"},
            "predicts actions alone, and with action_network 'modulate' from image tokens",
        ),
        ({"mlp_ratio": 1e308}, "a number that is too large"),
        ({"image_vocab_size": 10**400}, "a number that is too large"),
        ({"num_layers": 10**6}, "describes 1000000 layers, but there are only 57 tensors"),
    ],
)
def test_a_configuration_that_cannot_work_is_refused_by_name(changes, message, tmp_path):
    config = official_config(DISCRETE, ONE)
    folder = write_checkpoint(tmp_path / "a", config | changes, random_tensors(config, ONE))
    with pytest.raises(ConfigError, match=message) as caught:
        read_official(folder)
    assert str(folder / "config.json") in str(caught.value)


def test_the_variant_is_told_by_configuration_and_tensors_alike(tmp_path):
    config = official_config(DISCRETE, ONE)
    other = random_tensors(official_config(CONTINUOUS, ONE), ONE)
    with pytest.raises(ConfigError, match="config.json describes the discrete variant"):
        read_official(write_checkpoint(tmp_path / "a", config, other))


def test_what_is_no_checkpoint_is_said_so(tmp_path):
    with pytest.raises(ConfigError, match=r"no .*config.json"):
        read_official(tmp_path)
    (tmp_path / "config.json").write_text("{not json")
    with pytest.raises(ConfigError, match="is not JSON"):
        read_official(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ConfigError, match="neither model.safetensors"):
        read_official(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"\0" * 100)
    with pytest.raises(ConfigError, match="not a readable safetensors"):
        read_official(tmp_path)


def test_what_exists_is_not_overwritten_and_a_failure_leaves_nothing(tmp_path, monkeypatch):
    run = read_official(make_checkpoint(tmp_path / "a", DISCRETE, ONE))
    with pytest.raises(ConfigError, match="exists already"):
        write_official(run, tmp_path / "a")

    def break_down(*_):
        raise OSError("disk full")

    monkeypatch.setattr("hma_jax.convert.official.write_safetensors", break_down)
    with pytest.raises(OSError):
        write_official(run, tmp_path / "b")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_the_table_covers_every_parameter_of_every_model_once():
    for changes in ({}, {"conditioning": "cross_attention", "qk_norm": True}, {"conditioning": "add"}):
        config = model_config(qkv_bias=True, **changes)
        leaves = declare_model(config, TABLE).leaves()
        parts = [part for own in official_parts(config, TABLE, leaves).values() for part in own]
        assert len({part.name for part in parts}) == len(parts)
        assert len(official_shapes(config, TABLE)) == len(parts) + 2 * TABLE.size
