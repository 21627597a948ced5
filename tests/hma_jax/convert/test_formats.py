"""Runs, framework-neutral safetensors and StableHLO programs."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, DiffusionConfig, ExecutionConfig, MaskingConfig, SamplerConfig
from hma_jax.convert import (
    ProgramConfig,
    read_neutral,
    read_official,
    write_neutral,
    write_official,
    write_run,
    write_stablehlo,
)
from hma_jax.convert.stablehlo import generate_function
from hma_jax.convert.table import flat, nested
from hma_jax.convert.tensors import read_safetensors, write_safetensors
from hma_jax.generation import rollout
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import inference_params
from hma_jax.training.runs import Model, Run, load_run
from hma_jax.training.train import train_model
from tests.hma_jax.convert.fakes import CONTINUOUS, DISCRETE, make_checkpoint
from tests.tiny import TABLE, batches, lively_params, model_config, random_batch, shallow_config, train_config

PAGE = Path(__file__).parents[3] / "docs" / "checkpoints.md"
DIFFUSION = DiffusionConfig(channels=2, patch=2, width=8, depth=1)


def small_run(**changes) -> Run:
    config = model_config(frames=4, layers=1, **changes)
    params = jax.tree.map(np.asarray, lively_params(config)[1])
    return Run(config, train_config(steps=2), TABLE, params, 3, {"data": "random"})


def same(a: Run, b: Run) -> None:
    assert replace(a, params=None) == replace(b, params=None)
    x, y = flat(a.params), flat(b.params)
    assert x.keys() == y.keys()
    assert all(np.asarray(x[name]).tobytes() == np.asarray(y[name]).tobytes() for name in x)


@pytest.mark.parametrize("base", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_a_converted_checkpoint_is_a_run(base, tmp_path):
    run = read_official(make_checkpoint(tmp_path / "a", base, [("arm", 7, 2), ("push", 2, 1)]))
    write_run(run, tmp_path / "run")
    same(load_run(tmp_path / "run"), run)


@pytest.mark.slow
def test_training_goes_on_from_a_converted_run(tmp_path):
    run = replace(small_run(), step=0)
    write_run(run, tmp_path / "run")
    make = batches(run.model)
    result = train_model(run.model, run.table, run.train, make, run_dir=tmp_path / "run", provenance=run.provenance)
    assert result.resumed_from == 0 and len(result.losses) == 2
    after = load_run(tmp_path / "run")
    assert after.step == 2
    moved = np.abs(after.params["embed"]["tables"] - run.params["embed"]["tables"]).max()
    assert 0 < moved < 0.01


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, id="discrete", marks=pytest.mark.slow),
        pytest.param({"diffusion": DIFFUSION}, id="continuous"),
    ],
)
def test_safetensors_bring_everything_back(changes, tmp_path):
    run = small_run(**changes)
    write_neutral(run, tmp_path / "out")
    same(read_neutral(tmp_path / "out"), run)
    described = json.loads((tmp_path / "out" / "model.json").read_text())["tensors"]
    stored = read_safetensors(tmp_path / "out" / "model.safetensors")
    assert {name: tuple(t["shape"]) for name, t in described.items()} == {n: t.shape for n, t in stored.items()}
    assert described["stem/into/kernel"] == {"shape": [3, 14, 32], "axes": ["E", "U", "D"], "role": "input"}


def test_what_an_earlier_version_described_is_read_back(tmp_path):
    """As `load_run` reads its runs: without fields that came later."""
    run = small_run()
    run = replace(run, train=replace(run.train, ema_decay=0.5), weights="ema")
    write_neutral(run, tmp_path / "out")
    path = tmp_path / "out" / "model.json"
    earlier = json.loads(path.read_text())
    del earlier["model"]["recall"]
    path.write_text(json.dumps(earlier))
    same(read_neutral(tmp_path / "out"), run)


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_weights_in_half_precision_are_read_back_widened(dtype, tmp_path):
    run = small_run()
    write_neutral(run, tmp_path / "out")
    narrow = {name: x.astype(jnp.dtype(dtype)) for name, x in flat(run.params).items()}
    write_safetensors(tmp_path / "out" / "model.safetensors", narrow)
    same(
        read_neutral(tmp_path / "out"), replace(run, params=nested({n: x.astype("float32") for n, x in narrow.items()}))
    )
    write_safetensors(tmp_path / "out" / "model.safetensors", {n: x.astype("int32") for n, x in narrow.items()})
    with pytest.raises(ConfigError, match="not of type float32, float16, bfloat16: "):
        read_neutral(tmp_path / "out")


def test_settings_that_are_infinite_are_written_as_json_has_it_and_read_back(tmp_path):
    run = small_run(diffusion=replace(DIFFUSION, clip=math.inf))
    run = replace(run, train=replace(run.train, optimizer=replace(run.train.optimizer, clip_norm=math.inf)))
    write_neutral(run, tmp_path / "out")
    text = (tmp_path / "out" / "model.json").read_text()
    described = json.loads(text, parse_constant=lambda number: pytest.fail(f"{number} is no JSON"))
    assert described["model"]["diffusion"]["clip"] == "Infinity"
    same(read_neutral(tmp_path / "out"), run)


def test_what_does_not_fit_its_description_is_refused_by_name(tmp_path):
    write_neutral(small_run(), tmp_path / "out")
    path, weights = tmp_path / "out" / "model.json", tmp_path / "out" / "model.safetensors"
    good = json.loads(path.read_text())

    def refused(message, **changes):
        path.write_text(json.dumps(good | changes))
        with pytest.raises(ConfigError, match=message):
            read_neutral(tmp_path / "out")

    refused("version 2, but this program reads version 1", version=2)
    refused("not a model description of this project", format="other")
    refused("model.width", model=good["model"] | {"width": "wide"})
    refused("step must be a number of steps, got 2.5", step=2.5)
    refused("weights: 'auto' is not allowed; choose one of last, ema", weights="auto")
    refused("model: expected named fields, got int", model=3)
    refused("tensors: expected named fields, got NoneType", tensors=None)
    refused("provenance: expected named fields, got list", provenance=[])
    refused("embed/tables", model=good["model"] | {"factor_vocab": 16})
    refused(
        "embed/mask",
        tensors=good["tensors"] | {"embed/mask": {"shape": [32], "axes": ["H"], "role": "vector"}},
    )
    path.write_text(json.dumps(good))
    tensors = {name: tensor.read() for name, tensor in read_safetensors(weights).items()}
    write_safetensors(
        weights,
        {name: x for name, x in tensors.items() if name != "positions"} | {"other": tensors["positions"]},
    )
    with pytest.raises(ConfigError, match=r"1 missing: positions(.|\n)*1 not expected: other"):
        read_neutral(tmp_path / "out")


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path):
    run = small_run()
    run.params["embed"]["mask"] = np.full_like(run.params["embed"]["mask"], np.nan)
    write_neutral(run, tmp_path / "out")
    with pytest.raises(ConfigError, match="model.safetensors: embed/mask contains values that are not finite"):
        read_neutral(tmp_path / "out")


@pytest.mark.parametrize("write", [write_neutral, write_official, write_run, partial(write_stablehlo, config=None)])
def test_what_is_converted_is_a_run_with_the_weights_of_its_checkpoint(write, tmp_path):
    """A model was an AttributeError, and one in bfloat16 was written as if its weights had not been rounded."""
    run, execution = small_run(), ExecutionConfig(dtype="bfloat16")
    declared = declare_model(run.model, run.table, execution)
    model = Model(replace(run, params=inference_params(declared, run.params, "bfloat16")), declared, execution)
    for wrong, message in ((model, "is a Run, not a Model"), (model.run, "parameters are bfloat16, rounded for")):
        with pytest.raises(ConfigError, match=rf"{message}.*give load_run\(RUN, 'auto'\) of hma_jax.training.runs"):
            write(wrong, directory=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o007, 0o660)])
def test_weights_can_be_read_by_those_whom_the_umask_lets_read(umask, mode, tmp_path):
    """safetensors itself writes files for their owner alone, of no use to a colleague on a shared disk."""
    before = os.umask(umask)
    try:
        write_safetensors(tmp_path / "model.safetensors", {"one": np.zeros(3, np.float32)})
    finally:
        os.umask(before)
    assert (tmp_path / "model.safetensors").stat().st_mode & 0o777 == mode


SCRIPT = """
import json, sys
import numpy as np
import jax
from jax import export
from safetensors.numpy import load_file

folder = sys.argv[1]
about = json.load(open(f"{folder}/model.json"))
program = export.deserialize(bytearray(open(f"{folder}/model.stablehlo", "rb").read()))
weights = load_file(f"{folder}/model.safetensors")
given = np.load(f"{folder}/inputs.npz")
names = [one["name"] for one in about["inputs"]]
assert names == [f"weights/{name}" for name in sorted(weights)] + ["prompt", "actions", "embodiment", "key"]
unread = {name for i, name in enumerate(names) if i not in program.module_kept_var_idx}
assert unread <= {"weights/action_mask"}, unread
for one in about["inputs"][:-4]:
    array = weights[one["name"].removeprefix("weights/")]
    assert list(array.shape) == one["shape"] and array.dtype == one["dtype"], one
for one in about["inputs"][-4:]:
    assert list(given[one["name"]].shape) == one["shape"] and given[one["name"]].dtype == one["dtype"], one
out = program.call(weights, *(given[name] for name in names[-4:]))
assert list(out.shape) == about["outputs"][0]["shape"] and out.dtype == about["outputs"][0]["dtype"]
np.save(f"{folder}/frames.npy", out)
assert not [name for name in sys.modules if name.split(".")[0] in ("hma_jax", "experiments", "flax")]
"""


EXPORTED = {
    "discrete": ({}, DecodeConfig(2, 1.0), 4, "float32"),
    "past the window in bfloat16": ({}, DecodeConfig(2, 1.0, slide="streaming"), 7, "bfloat16"),
    "continuous, past the window": (
        {"diffusion": DIFFUSION},
        DecodeConfig(2, sampler=SamplerConfig(steps=3)),
        6,
        "float32",
    ),
}
"""(changes of the model, decoding, frames, type) of a program."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Writes a program of EXPORTED, once; returns its directory."""

    @functools.cache
    def write(name: str) -> Path:
        changes, decode, frames, dtype = EXPORTED[name]
        out = tmp_path_factory.mktemp("exported") / "program"
        config = ProgramConfig(batch=2, prompt=2, frames=frames, decode=decode, dtype=dtype)
        write_stablehlo(small_run(**changes), out, config)
        return out

    return write


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * ("continuous" in n)) for n in EXPORTED])
def test_the_program_generates_the_same_frames_where_this_project_is_not_installed(name, exported):
    changes, decode, frames, dtype = EXPORTED[name]
    run, out = small_run(**changes), exported(name)
    batch = random_batch(0, replace(run.model, frames=frames), 2)
    key = np.array([7, 11], np.uint32)
    given = {
        "prompt": batch["tokens"][:, :2],
        "actions": batch["actions"],
        "embodiment": batch["embodiment"],
        "key": key,
    }
    np.savez(out / "inputs.npz", **given)
    done = subprocess.run([sys.executable, "-I", "-c", SCRIPT, str(out)], capture_output=True, text=True, cwd="/")
    assert done.returncode == 0, done.stderr
    about = json.loads((out / "model.json").read_text())
    assert [about[name] for name in ("step", "weights", "setting", "provenance")] == [
        3, "last", "forward", {"data": "random"},
    ]  # fmt: skip

    declared = declare_model(run.model, TABLE, ExecutionConfig(dtype, attention="plain"))
    keys = jnp.stack([jax.random.fold_in(jax.random.wrap_key_data(key), row) for row in range(2)])
    args = (given["prompt"], batch["actions"][:, None], batch["embodiment"], keys, decode)
    params = inference_params(declared, run.params, dtype)
    want = jax.jit(lambda p: rollout(declared.merge(p), *args))(params)[:, 0]
    got = np.load(out / "frames.npy")
    if run.model.diffusion:
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-4)
    else:
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(
    ("zeros", "others"),
    [
        ('np.zeros(inputs["embodiment"]["shape"], np.int32)', 'np.full(inputs["embodiment"]["shape"], 3, np.int32)'),
        ('np.zeros(inputs["prompt"]["shape"], np.int32)', 'np.full(inputs["prompt"]["shape"], 64, np.int32)'),
    ],
    ids=["robot", "id"],
)
def test_the_page_s_caller_of_a_program_refuses_robots_and_ids_that_there_are_not(zeros, others, exported, monkeypatch):
    """The program makes frames of them that look like others."""
    (text,) = (one for one in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S) if "export" in one)
    monkeypatch.chdir(exported("discrete").parent)
    names: dict = {}
    exec(text, names)
    assert names["frames"].shape == (2, 2, 9)
    assert text.count(zeros) == 1
    with pytest.raises(AssertionError):
        exec(text.replace(zeros, others), {})


@pytest.mark.slow
def test_a_program_shows_no_action_that_its_model_was_trained_without():
    """Stem and modulation of such a robot are as they were drawn: noise to every frame."""
    config, silent = shallow_config(frames=3), Embodiment("film", 0, 1, (), ())
    batch, program = random_batch(0, config, 2), ProgramConfig(batch=2, prompt=1, frames=3)
    given = batch["tokens"][:, :1], batch["embodiment"], np.array([0, 7], np.uint32)

    def frames(setting, table, robot, actions):
        prompt, _, key = given
        generate = jax.jit(generate_function(config, table, setting, program))
        weights = flat(lively_params(config, table)[1])
        return np.asarray(generate(weights, prompt, actions, np.full(2, robot, np.int32), key))

    actions, films = batch["actions"], EmbodimentTable((*TABLE.entries, silent))
    passive, film, arm = ("passive", TABLE, 1), ("forward", films, 3), ("forward", films, 1)
    for case in (passive, film):
        np.testing.assert_array_equal(frames(*case, actions), frames(*case, 3 * actions))
    assert (frames(*arm, actions) != frames(*arm, 3 * actions)).any()


def test_a_program_that_cannot_be_is_refused(tmp_path):
    policy = replace(small_run(), train=train_config(masking=MaskingConfig(setting="policy")))
    with pytest.raises(ConfigError, match="'policy', which predicts no frames"):
        write_stablehlo(policy, tmp_path / "out", ProgramConfig(prompt=2, frames=4))
    with pytest.raises(ConfigError, match="frames must be more than prompt"):
        ProgramConfig(prompt=3, frames=3)
    with pytest.raises(ConfigError, match="choose some of cpu, cuda"):
        ProgramConfig(platforms=("abacus",))
    assert not (tmp_path / "out").exists()
