"""What a user meets when data, directories or checkpoints are wrong: one message that says what,
where and what to do, an exit code, and no traceback.

All of it goes through `main`, on tiny RLDS datasets under registered names. No step here
learns anything: what a step computes is tested elsewhere.
"""

import gc
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.registry import get_spec
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.identity import EpisodeRun, episode_ids
from data_pipelines.sources.rlds.schema import DATASETS
from data_pipelines.tokens import tokenize_job
from data_pipelines.windows.evalset import EvalManifest
from experiments.cli.data import registry as registry_commands
from experiments.cli.main import main
from experiments.preparing import tokenizer, windows
from experiments.preparing.sources import say_short_episodes
from experiments.presets import get_preset
from experiments.running.workspace import Workspace
from hma_jax.config import require
from hma_jax.convert import read_official, write_run
from hma_jax.evaluation import evaluate as evaluation
from hma_jax.evaluation.parts import Parts
from hma_jax.evaluation.windows import WindowTable
from hma_jax.tokenizers import train as tokenizer_training
from hma_jax.training import train as model_training
from hma_jax.training.hashes import write_list
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.hma_jax.convert.fakes import DISCRETE, make_checkpoint

ARM, BASE = map(get_spec, ("berkeley_gnm_cory_hall", "ucsd_pick_and_place_dataset_converted_externally_to_rlds"))
LENGTHS = [12, 13, 14, 15, 12, 13]  # a whole window of the smoke study takes 12 native frames
SMOKE = ("--preset", "smoke")


def idle_step(*_):
    """A training step that counts."""

    def step(state, batch):
        return state._replace(step=state.step + 1), {"loss": jnp.float32(5), "psnr": jnp.float32(5)}

    return step


@pytest.fixture(scope="module", autouse=True)
def idle_training():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tokenizer_training, "make_train_step", idle_step)
        patch.setattr(model_training, "make_train_step", idle_step)
        patch.setattr(tokenizer, "QUALITY_FRAMES", 8)
        yield


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return write_rlds(tmp_path_factory.mktemp("rlds"), ARM, LENGTHS, shards=2)


@pytest.fixture(scope="module")
def study(arm, tmp_path_factory):
    """A prepared study with a trained model; its second dataset is too short for any window."""
    root = tmp_path_factory.mktemp("study")
    short = write_rlds(root / "rlds", BASE, [3, 2, 3, 3])
    data = ("--data", str(arm), str(short))
    assert main(["train", *SMOKE, "--out", str(root / "out"), *data, "--checkpoint-every", "1"]) == 0
    return root / "out", data


@pytest.fixture
def refused(capsys):
    """Runs a command that must fail; returns its message."""

    def run(code: int, *arguments: object) -> str:
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == code
        said = capsys.readouterr().err
        assert said.startswith("error: ") and said.count("error: ") == 1, said
        assert "Traceback" not in said and len(said) < 1500, said
        return said

    return run


def test_what_one_of_many_datasets_lacks_is_said_before_anything_is_made(arm, tmp_path, monkeypatch, refused):
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: pytest.fail("it is trained"))
    monkeypatch.setattr(tokenize_job, "write_dataset", lambda *_, **__: pytest.fail("it is tokenised"))
    monkeypatch.setattr(registry_table, "_registered", {})
    data = ["--data", arm, write_rlds(tmp_path / "rlds", BASE, LENGTHS), "--out", tmp_path / "out"]
    message = refused(2, "tokenize", *SMOKE, *data, "--set", "store.frame_step=3")
    assert f"dataset {BASE.name!r}: frame_step 3 does not divide the stride 2 of 2 Hz" in message
    assert main(["tokenizer", "pixels", "--out", str(tmp_path / "pixels")]) == 0
    given = ["--preset", "smoke-continuous", "--tokenizer", tmp_path / "pixels"]
    (tmp_path / "my.toml").write_text(to_toml(replace(BASE, image_key="observation/none")))
    message = refused(2, "tokenize", *given, *data, "--registry", tmp_path / "my.toml")
    assert f"{BASE.name}: no image 'observation/none'" in message


def test_one_episode_alone_is_refused_before_a_tokenizer_is_trained_on_it(tmp_path, monkeypatch, refused):
    """None of it is held out to judge the tokenizer by."""
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: pytest.fail("it is trained"))
    rlds = write_rlds(tmp_path / "rlds", ARM, [12])
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds)
    assert f"{ARM.name}: it has no val episode: of 1 none is held out: this needs at least two" in message
    rlds = write_rlds(tmp_path / "more", ARM, [12] * 7)
    none = ("--set", "store.val_fraction=0.01", "--set", "store.min_val=0")
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds, *none)
    assert "of 7 none is held out" in message and "val_fraction=0.01, min_val=0 and max_val=200 set how many" in message


# --- Data ------------------------------------------------------------------------------------


def shard(directory: Path, number: int = 0) -> Path:
    return sorted(directory.glob("*.tfrecord-*"))[number]


def truncate(directory: Path) -> None:
    whole = shard(directory).read_bytes()
    shard(directory).write_bytes(whole[:-9])


def flip(at: int) -> Callable[[Path], None]:
    def spoil(directory: Path) -> None:
        content = bytearray(shard(directory).read_bytes())
        content[at] ^= 4
        shard(directory).write_bytes(content)

    return spoil


def lose_shard(directory: Path) -> None:
    shard(directory, 1).unlink()


def empty_shard(directory: Path) -> None:
    shard(directory).write_bytes(b"")


def lose_schema(directory: Path) -> None:
    (directory / "features.json").unlink()


def garble_info(directory: Path) -> None:
    (directory / "dataset_info.json").write_text("{")


def empty(directory: Path) -> None:
    shutil.rmtree(directory)
    directory.mkdir()


DAMAGE = {
    "truncated shard": (truncate, ["{shard}", "corrupt record at byte", "truncated", "Download the file again"]),
    "bit of a length": (flip(3), ["{shard}", "byte 0", "checksum", "corrupt='skip'"]),
    "bit of a record": (flip(300), ["{shard}", "byte 0", "checksum of the record's data", "corrupt='skip'"]),
    "missing shard": (lose_shard, ["00001-of-00002", "the shard is missing", "Download it again"]),
    "empty shard": (empty_shard, ["{shard}", "0 records", "says 3", "Download the shard again"]),
    "missing schema": (lose_schema, ["{dir}", "features.json", "Restore"]),
    "damaged metadata": (garble_info, ["{dir}", "dataset_info.json", "Restore"]),
    "empty directory": (empty, ["{dir}", "it holds nothing", "as tfds wrote it"]),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_dataset(name, arm, tmp_path, refused):
    spoil, parts = DAMAGE[name]
    directory = shutil.copytree(arm, tmp_path / ARM.name / "1.0.0")
    path = shard(directory)
    spoil(directory)
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", directory)
    for part in parts:
        assert part.format(shard=path, dir=directory) in message
    assert not list((tmp_path / "out").glob("tokens/*/manifest.json")), "half a dataset was kept"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_actions_that_are_not_finite(value, tmp_path, refused):
    def spoil(episode, features):
        if episode == 3:
            features["steps/action"][7] = value

    rlds = write_rlds(tmp_path, ARM, LENGTHS, change=spoil)
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds)
    for part in (ARM.name, "episode 3", "'steps/action'", "not finite at step 7", "--set store.corrupt=skip"):
        assert part in message


def test_damage_can_be_left_out_and_is_counted(arm, tmp_path, capsys):
    directory = shutil.copytree(arm, tmp_path / ARM.name / "1.0.0")
    flip(300)(directory)
    arguments = ("--out", str(tmp_path / "out"), "--data", str(directory), "--set", "store.corrupt=skip")
    assert main(["tokenize", *SMOKE, *arguments]) == 0
    said = capsys.readouterr().out
    assert f"{ARM.name}: 1 damaged episodes are left out" in said
    assert "checksum of the record's data" in said.split(f"lost {ARM.name}: ")[1] and "corrupt='skip'" not in said
    manifest = tmp_path / "out" / "tokens" / ARM.name / "manifest.json"
    assert "corrupt='skip'" in manifest.read_text()  # its hash covers the whole message
    (facts,) = json.loads((tmp_path / "out" / "data.json").read_text()).values()
    assert facts["skipped"] == 1


def test_more_damage_than_allowed_is_an_error_even_so(tmp_path, refused):
    held = held_out(ARM.name, episode_ids([EpisodeRun(f"{ARM.name}-train.tfrecord-00000-of-00001", 0, 24)]), HeldOut())
    kept = (int(np.flatnonzero(held)[0]), int(np.flatnonzero(~held)[0]))  # one to judge, one to train on
    bad = [e for e in range(24) if e not in kept]

    def spoil(episode, features):
        if episode in bad:
            features["steps/action"][0] = np.nan

    rlds = write_rlds(tmp_path, ARM, [12] * 40, change=spoil)
    skip = ("--set", "store.corrupt=skip", "--set", "store.min_val=8")  # some of those held out are whole
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds, *skip)
    assert "17 episodes cannot be used, more than max_skipped=16" in message
    assert f"episode {bad[16]}" in message and "corrupt=" not in message
    assert "To use the others, raise the limit: --set store.max_skipped=N." in message
    allowed = ("--set", "store.max_skipped=22")
    arguments = map(str, ("tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds, *skip, *allowed))
    assert main(list(arguments)) == 0


def test_unknown_dataset_name(tmp_path, refused):
    rlds = write_rlds(tmp_path, make_spec("berkeley_gnm_cory_hal", (2,)), LENGTHS)
    message = refused(2, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds)
    assert "unknown dataset 'berkeley_gnm_cory_hal'; did you mean berkeley_gnm_cory_hall" in message
    assert "data_pipelines/registry/own.py" in message and "hma data inspect" in message


def test_all_datasets_without_an_entry_and_all_that_are_none_are_named_at_once(tmp_path, refused):
    """With twenty new datasets it took twenty attempts to learn their names."""
    places = [
        write_rlds(tmp_path / f"{i}", make_spec(name, (2,)), [3]) for i, name in enumerate(("new_arm", "new_car"))
    ]
    known = write_rlds(tmp_path, ARM, LENGTHS)
    message = refused(2, "study", *SMOKE, "--out", tmp_path / "out", "--data", known, *places)
    for name, place in zip(("new_arm", "new_car"), places, strict=True):
        (line,) = [line for line in message.splitlines() if name in line]
        assert f"unknown dataset '{name}'" in line and f" {place} " in line
    assert ARM.name not in message and message.count("hma data inspect") == 1
    none = [tmp_path / "README.md", tmp_path / "downloads"]
    none[0].write_text("x")
    (none[1] / "x").mkdir(parents=True)
    message = refused(2, "study", *SMOKE, "--out", tmp_path / "out", "--data", none[0], known, none[1])
    assert all(str(place) in message for place in none) and ARM.name not in message


def test_unknown_dataset_of_the_suite(tmp_path, refused):
    names = "datasets=rover_road,pushr_sand,arm_chalk"
    message = refused(2, "data", "suite", *SMOKE, "--out", tmp_path / "out", "--set", names)
    assert "unknown dataset 'pushr_sand'; did you mean pusher_sand" in message


def test_wrong_image_key(tmp_path, refused):
    """The registry says image_0 of this dataset, its schema says image."""
    rlds = write_rlds(tmp_path, get_spec("bridge_dataset"), LENGTHS)
    message = refused(2, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds)
    for part in ("bridge_dataset", "no image 'observation/image_0'", "features.json", "Correct image_key"):
        assert part in message
    assert "images there: observation/image" in message


def test_wrong_number_of_action_values(tmp_path, refused):
    rlds = write_rlds(tmp_path, replace(ARM, action_dims=(5,)), LENGTHS)
    message = refused(2, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", rlds)
    assert ARM.name in message and "has 5 values" in message and "2 were expected" in message


def test_two_directories_of_one_dataset(arm, tmp_path, refused):
    """A copy, or another version, under a directory of whatever name."""
    other = shutil.copytree(arm, tmp_path / "corrected")
    message = refused(2, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", arm, other)
    assert f"{arm} and {other} are both the dataset {ARM.name!r}" in message and "leave one out" in message


# --- Windows ---------------------------------------------------------------------------------


def test_episodes_that_an_entry_says_are_too_short_are_told_before_a_tokenizer_is_trained(
    arm, tmp_path, monkeypatch, capsys
):
    """How long each is, tokenising finds out. Without a word a tokenizer was trained for nothing."""
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: require(False, "it would be trained"))
    for steps, told in (8.0, True), (9.0, False), (0.0, False):  # 0: the entry does not say it
        monkeypatch.setattr(registry_table, "_registered", {ARM.name: replace(ARM, mean_steps=steps)})
        assert main(["tokenize", *SMOKE, "--out", str(tmp_path / "out"), "--data", str(arm)]) == 2
        said, note = capsys.readouterr(), f"{ARM.name} (about {steps:g} steps an episode; 9 are needed)"
        assert "it would be trained" in said.err and (note in said.out) == told
        assert main(["train", *SMOKE, "--out", str(tmp_path / "new"), "--data", str(arm), "--dry-run"]) == 0
        assert (note in capsys.readouterr().out) == told


def test_thousands_of_steps_are_written_out(capsys):
    """They were "about 1.23e+03 steps"."""
    spec = replace(ARM, hz=1000.0, mean_steps=1234.56)
    say_short_episodes(get_preset("smoke"), [(spec, Path())])
    assert f"{ARM.name} (about 1,234.6 steps an episode; 1,500 are needed)" in capsys.readouterr().out


def test_so_are_those_of_data_that_replace_others_of_which_windows_are_there(arm, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: require(False, "it would be trained"))
    monkeypatch.setattr(registry_table, "_registered", {ARM.name: replace(ARM, mean_steps=8.0)})
    Workspace(tmp_path).manifest.write_text("{}")  # of an earlier version, say
    assert main(["tokenize", *SMOKE, "--out", str(tmp_path), "--data", str(arm), "--replace", "tokenizer"]) == 2
    said = capsys.readouterr()
    assert "it would be trained" in said.err and f"{ARM.name} (about 8 steps an episode; 9 are needed)" in said.out


def test_dataset_without_a_window_is_reported_and_left_out(study, capsys):
    """Its windows are counted; the study goes on without it, through training and evaluation."""
    out, data = study
    assert main(["tokenize", *SMOKE, "--out", str(out), *data]) == 0
    said = capsys.readouterr().out
    assert f"{BASE.name}: 3 of 3 training episodes are too short for any window" in said
    assert "it is not evaluated: a window has at least 3 frames, which at stride 2 need 6 native frames" in said
    assert "or a shorter prompt (--set eval.prompt_frames=N) may give it windows" in said
    assert f"1 of 2 datasets can be trained on; {BASE.name} has no training window" in said
    facts = json.loads((out / "data.json").read_text())
    assert facts[BASE.name] == {
        "episodes": 3, "too_short": 3, "padded": 0, "windows": 0, "held_out": 1, "skipped": 0
    }  # fmt: skip
    assert facts[ARM.name]["too_short"] == 0 and facts[ARM.name]["windows"] > 0


def test_windows_that_end_with_padding_are_one_line_however_many_datasets_have_them(capsys):
    """Where it is most of the episodes first; those that are not named stand in a file."""
    facts = {f"robot_{i}": {"padded": i, "episodes": 10} for i in range(6)}
    windows.say_padded(facts, 12, "data.json")
    (line,) = capsys.readouterr().out.splitlines()
    named = "5 of 10 of robot_5, 4 of 10 of robot_4, 3 of 10 of robot_3 and 2 more (data.json)"
    assert line.endswith(f"too short for 12 frames, whose windows end with padding: {named}")
    windows.say_padded({"whole": {"padded": 0, "episodes": 10}}, 12, "data.json")
    assert capsys.readouterr().out == ""


def test_no_window_at_all(arm, tmp_path, refused):
    long = ("--set", "model.frames=8", "--set", "eval.prompt_frames=7")
    message = refused(1, "tokenize", *SMOKE, "--out", tmp_path / "out", "--data", arm, *long)
    assert "no val episode is long enough for a window" in message and ARM.name in message
    assert (
        "a window has at least 8 frames, which at stride 3 need 24 native frames" in message
        and "a shorter prompt" in message
    )


def test_a_judged_dataset_without_windows_stops_the_study(study, refused):
    """Each point would say of two datasets what was made with one."""
    out, data = study
    message = refused(2, "study", *SMOKE, "--out", out, *data)
    assert f"{BASE.name} is to be evaluated, but has no held-out window: a window has at least 3 frames" in message
    assert f"{BASE.name} has no training window" in message and "Leave it out of the study" in message
    assert not list(out.glob("trials/*/result.json"))


# --- Directories -----------------------------------------------------------------------------


WRITERS = ("study", "sweep width", "data suite", "tokenizer train", "tokenize", "train")


@pytest.mark.parametrize("command", WRITERS)
def test_output_directory_that_cannot_be_made(command, tmp_path, refused):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    message = refused(2, *command.split(), *SMOKE, "--out", out)
    assert f"cannot write to {out}" in message and "choose another --out" in message


def test_run_directory_that_cannot_be_made(study, tmp_path, refused):
    out, data = study
    (tmp_path / "file").write_text("")
    message = refused(2, "train", *SMOKE, "--out", out, *data, "--run", tmp_path / "file" / "run")
    assert str(tmp_path / "file" / "run") in message and "choose another output directory" in message


@pytest.mark.parametrize(
    "arguments", [["tokenize", "--out", "gs://bucket/out"], ["train", "--run", "s3://bucket/run"]], ids=["out", "run"]
)
def test_what_would_be_written_to_a_bucket_is_refused(arguments, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refused(2, *arguments, *SMOKE)
    assert "results cannot be written to a bucket, only to a directory of a file system" in message and not list(
        tmp_path.iterdir()
    )


def test_processes_that_do_not_know_each_other_are_refused(refused):
    message = refused(2, "train", *SMOKE, "--processes", "2")
    assert "--coordinator HOST:PORT, --processes N and --process I" in message


def test_disk_that_fills_up_later(study, tmp_path, refused, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device", str(path))

    out, data = study
    monkeypatch.setattr(windows, "write_file", full)
    message = refused(1, "tokenize", *SMOKE, "--out", out, *data)
    assert f"{out / 'data.json'}: No space left on device" in message and "the space on its disk" in message


@pytest.mark.parametrize("name", ["tokens", "tokenizer", "eval_manifest.json"])
def test_evaluation_without_what_was_prepared(name, study, tmp_path, refused):
    out, data = study
    other = tmp_path / "out"
    shutil.copytree(out, other)
    shutil.rmtree(other / name) if (other / name).is_dir() else (other / name).unlink()
    message = refused(2, "evaluate", out / "model", *SMOKE, "--out", other, *data)
    assert f"{other / name}: not made yet; run `hma tokenize --preset smoke --out {other} --data {data[1]}" in message


def test_report_of_an_empty_directory(tmp_path, refused):
    message = refused(2, "report", tmp_path)
    assert f"no study in {tmp_path}" in message and "hma study" in message


# --- Checkpoints -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "difference"),
    [
        ("model.mlp_ratio=2", "model.mlp_ratio: 4.0 -> 2.0"),
        ("train.batch=2", "train.batch: 4 -> 2"),
        ("train.optimizer.learning_rate=0.1", "train.optimizer.learning_rate: 0.001 -> 0.1"),
        ("weighed=all", "provenance.loader.weighed: 'used' -> 'all'"),
    ],
)
def test_training_is_not_resumed_under_another_configuration(setting, difference, study, refused):
    out, data = study
    before = (out / "model" / "metrics.jsonl").read_bytes()
    message = refused(2, "train", *SMOKE, "--out", out, *data, "--set", setting)
    assert str(out / "model") in message and "use a new output directory" in message
    assert message.rstrip().endswith("\n  " + difference)  # and nothing else differs
    assert (out / "model" / "metrics.jsonl").read_bytes() == before


def test_training_is_not_resumed_on_other_data(study, tmp_path, refused):
    out, data = study
    other = shutil.copytree(out, tmp_path / "out")
    longer = write_rlds(tmp_path, ARM, [20] * 6)
    message = refused(2, "train", *SMOKE, "--out", other, "--data", longer, data[-1], "--replace", "tokenizer")
    assert "provenance.store: " in message and str(other / "model") in message


def test_run_of_another_kind(study, tmp_path, refused):
    out, data = study
    copied = shutil.copytree(out / "tokenizer", tmp_path / "copied")
    message = refused(2, "train", *SMOKE, "--out", out, *data, "--run", copied)
    assert "another kind of run" in message and "use a new output directory" in message
    message = refused(2, "evaluate", out / "tokenizer", *SMOKE, "--out", out, *data)
    assert f"{out / 'tokenizer'}: not a run of this project (no model, table)" in message


def nothing(path: Path) -> None:
    pass


@pytest.mark.parametrize("make", [nothing, Path.mkdir, Path.touch])
def test_evaluation_of_what_is_no_run(make, study, tmp_path, refused):
    out, data = study
    make(tmp_path / "run")
    message = refused(2, "evaluate", tmp_path / "run", *SMOKE, "--out", out, *data)
    assert f"no checkpoints at {tmp_path / 'run'}" in message and "the directory of a training run" in message


def test_evaluation_of_a_study_names_a_run_in_it(study, tmp_path, refused):
    out, data = study
    for run in ("model", "trials/1a/run"):
        (tmp_path / run / "checkpoints").mkdir(parents=True)
    message = refused(2, "evaluate", tmp_path, *SMOKE, "--out", out, *data)
    assert f"such as {tmp_path / 'model'} or {tmp_path / 'trials' / '1a' / 'run'}" in message


def prepared_otherwise(study, root: Path, *settings: str, data: tuple[str, ...] | None = None) -> Path:
    """A study that was prepared in another way."""
    other = shutil.copytree(study[0], root / "out")
    changes = [word for setting in settings for word in ("--set", setting)]
    where = ["--out", str(other), *(data or study[1]), *changes]
    assert main(["tokenize", *SMOKE, *where, "--replace", "tokenizer"]) == 0
    return other


def test_evaluation_on_tokens_of_another_tokenizer(study, tmp_path, refused):
    other = prepared_otherwise(study, tmp_path, "tokenizer.channels=8")
    for command, asked in (("evaluate", (*SMOKE, *study[1])), ("check", ())):
        message = refused(2, command, study[0] / "model", "--out", other, *asked)
        assert "trained on tokens of tokenizer" in message and "the --out it was trained in" in message


def test_evaluation_on_windows_of_another_length(study, tmp_path, refused):
    other = prepared_otherwise(study, tmp_path, "model.frames=3")
    message = refused(2, "evaluate", study[0] / "model", *SMOKE, "--out", other, *study[1])
    assert "windows of 4 frames" in message and "have 3" in message and "the --out it was" in message


@pytest.mark.parametrize(
    ("changes", "robot", "why", "advice"),
    [
        (
            {"S": 64},
            ARM.name,
            "the model needs 64 tokens",
            "--tokenizer and the directory of the one that it was trained",
        ),
        (
            {"T": 3},
            ARM.name,
            "windows of 3 frames, but those frozen for evaluation here have 4",
            "--set model.frames=3",
        ),
        ({}, "push2", "trained on push2, but the study has no windows of these", "--data of one of them"),
    ],
    ids=["tokens", "frames", "data"],
)
def test_evaluation_of_a_converted_model_on_what_does_not_fit_it(changes, robot, why, advice, study, tmp_path, refused):
    """It was trained in no --out of ours."""
    smoke = {"d_model": 8, "T": 4, "S": 16, "image_vocab_size": 256}
    robots = [(robot, ARM.action_dim, ARM.stride)]
    write_run(read_official(make_checkpoint(tmp_path / "a", DISCRETE | smoke | changes, robots)), tmp_path / "run")
    message = refused(2, "evaluate", tmp_path / "run", *SMOKE, "--out", study[0], *study[1])
    assert why in message and f"; prepare a study with {advice}" in message and "trained in" not in message


def test_data_of_no_robot_of_the_model_is_refused_before_it_is_made_into_tokens(study, tmp_path, refused):
    smoke = {"d_model": 8, "T": 4, "S": 16, "image_vocab_size": 256}
    robots = [("push2", ARM.action_dim, ARM.stride)]
    write_run(read_official(make_checkpoint(tmp_path / "a", DISCRETE | smoke, robots)), tmp_path / "run")
    _, arm, _ = study[1]
    message = refused(2, "evaluate", tmp_path / "run", *SMOKE, "--out", tmp_path / "new", "--data", arm)
    assert f"the model knows push2, but --data has {ARM.name}" in message
    assert f'add joins = ["{ARM.name}"] to its entry' in message


@pytest.mark.slow
def test_evaluation_in_a_study_without_some_of_its_datasets_says_which(study, tmp_path, capsys):
    option, arm, base = study[1]
    other = prepared_otherwise(study, tmp_path, data=(option, arm))
    assert main(["evaluate", str(study[0] / "model"), *SMOKE, "--out", str(other), option, base]) == 0
    said = capsys.readouterr().out
    assert f"not evaluated, because the study does not have them: {BASE.name}" in said
    assert f"also those of {ARM.name}, which --data does not name" in said


def test_evaluation_says_where_its_windows_are_of_other_recordings_than_data_names(
    study, tmp_path, monkeypatch, capsys
):
    out, (option, arm, base) = study
    longer, to = write_rlds(tmp_path, ARM, [20] * 6), ("--to", str(tmp_path / "to"))
    monkeypatch.setattr("experiments.cli.evaluate.step", lambda _: require(False, "it would evaluate"))

    def said(*data: object) -> str:
        assert main(["evaluate", str(out / "model"), *SMOKE, "--out", str(out), option, *map(str, data), *to]) == 2
        return capsys.readouterr().out

    note = f"note: the windows frozen in {out} are evaluated, whose tokens were made from other data than --data"
    assert note not in said(arm, base)
    found = said(longer, base)
    assert note in found and "source: " in found and f"({ARM.name})" in found


def test_evaluation_says_why_a_dataset_of_the_study_has_no_window(study, tmp_path, monkeypatch, capsys):
    out, data = study
    monkeypatch.setattr("experiments.cli.evaluate.step", lambda _: require(False, "it would evaluate"))
    assert main(["evaluate", str(out / "model"), *SMOKE, "--out", str(out), *data, "--to", str(tmp_path / "to")]) == 2
    (note,) = [line for line in capsys.readouterr().out.splitlines() if BASE.name in line and "evaluated" in line]
    assert note.startswith(
        f"note: {BASE.name} is not evaluated: a window has at least 3 frames, which at stride 2 need 6"
    )


def test_evaluation_with_a_prompt_that_fills_the_window(study, refused):
    out, data = study
    settings = ("--set", "model.frames=5", "--set", "eval.prompt_frames=4")
    message = refused(2, "evaluate", out / "model", *SMOKE, "--out", out, *data, *settings, "--replace")
    assert "eval.prompt_frames 4 leaves no frame to predict in a window of 4 frames" in message


CHECKPOINT_FILES = ("_CHECKPOINT_METADATA", "_METADATA", "manifest.ocdbt", "array_metadatas/process_0")


@pytest.mark.parametrize("name", CHECKPOINT_FILES)
@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_damaged_checkpoint(command, name, study, tmp_path, refused):
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    for file in (run / "checkpoints" / "3").rglob(name):
        file.write_bytes(file.read_bytes()[:-30])
    run_argument = (run,) if command == "evaluate" else ("--run", run)
    message = refused(2, command, *run_argument, *SMOKE, "--out", out, *data)
    assert f"{run / 'checkpoints' / '3'} is damaged: " in message and name in message
    assert "that of step 2 is undamaged: to continue from there, train with --skip-damaged" in message


def test_training_goes_on_before_the_damage_when_told_to(study, tmp_path, refused):
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    file = next((run / "checkpoints" / "3" / "opt_state" / "d").iterdir())
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    command = ("train", *SMOKE, "--out", out, *data, "--run", run)
    assert file.name in refused(2, *command)
    assert main([*map(str, command), "--skip-damaged"]) == 0
    assert (run / "damaged" / "3").is_dir() and (run / "checkpoints" / "3").is_dir()
    assert (run / "metrics.jsonl").read_bytes() == (out / "model" / "metrics.jsonl").read_bytes()
    assert main([*map(str, command)]) == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # background readers
@pytest.mark.parametrize("command, name", [("train", "array_metadatas/process_0"), ("evaluate", "manifest.ocdbt")])
def test_damaged_checkpoint_of_an_earlier_version(command, name, study, tmp_path, refused):
    """None of the run has a list of its files: what Orbax finds is all there is to say."""
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    for file in (run / "checkpoints").glob("*/sha256.json"):
        file.unlink()
    for file in (run / "checkpoints" / "3").rglob(name):
        file.write_bytes(file.read_bytes()[:-30])
    run_argument = (run,) if command == "evaluate" else ("--run", run)
    message = refused(2, command, *run_argument, *SMOKE, "--out", out, *data)
    assert f"{run / 'checkpoints' / '3'} cannot be read" in message and "remove this directory" in message
    gc.collect()  # what the readers left behind complains here, not in another test


# --- The program -----------------------------------------------------------------------------


def hma(*arguments: object) -> tuple[int, str]:
    """Exit code and standard error of a real process."""
    command = [sys.executable, "-m", "experiments.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stderr


def test_the_process_says_the_same(tmp_path):
    code, said = hma("tokenize", *SMOKE, "--out", tmp_path / "out", "--data", tmp_path / "none")
    assert code == 2
    assert said == f"error: {tmp_path / 'none'}: no such directory. Give {DATASETS}.\n"


def test_background_readers_of_a_damaged_checkpoint_stay_silent(study, tmp_path):
    """They complain from threads and destructors, in pages, until the process ends."""
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    for file in (run / "checkpoints").glob("*/sha256.json"):  # as an earlier version left it: Orbax meets the damage
        file.unlink()
    for file in (run / "checkpoints" / "3").rglob("array_metadatas/process_0"):
        file.write_bytes(file.read_bytes()[:-30])
    code, said = hma("train", *SMOKE, "--out", out, *data, "--run", run)
    *remarks, error = said.splitlines()
    assert code == 2 and error.startswith("error: the checkpoint")
    assert remarks and all("without checking their hashes" in remark for remark in remarks)


def test_a_bug_is_not_dressed_up_as_a_mistake_of_the_user(monkeypatch):
    def broken(*_):
        raise KeyError("oops")

    monkeypatch.setattr(registry_commands, "use_entries", broken)
    with pytest.raises(KeyError, match="oops"):
        main(["data", "list"])


def test_a_path_that_is_not_utf8_is_refused_at_the_start(tmp_path, monkeypatch, capsys):
    """Its suite was simulated first, and then there was a traceback."""
    latin = tmp_path / os.fsdecode(b"caf\xe9")
    latin.mkdir()
    assert main(["study", *SMOKE, "--out", str(latin)]) == 2
    assert "caf\\xe9 is not UTF-8" in capsys.readouterr().err and not any(latin.iterdir())
    monkeypatch.chdir(latin)
    assert main(["study", *SMOKE, "--out", "out"]) == 2
    assert "caf\\xe9 is not UTF-8" in capsys.readouterr().err and not any(latin.iterdir())


class Stopped(Parts):
    """The parts of an evaluation that is stopped after its first batch."""

    def add(self, n, part):
        super().add(n, part)
        raise KeyboardInterrupt


def test_an_evaluation_that_was_stopped_goes_on(study, tmp_path, monkeypatch):
    out, data = study
    command = ["evaluate", str(out / "model"), *SMOKE, "--out", str(out), *map(str, data), "--set", "eval.batch=1"]
    assert main([*command, "--to", str(tmp_path / "whole")]) == 0
    to, sent, put = tmp_path / "stopped", [], evaluation._put
    monkeypatch.setattr(evaluation, "_put", lambda *batch: sent.append(batch) or put(*batch))

    with monkeypatch.context() as patch:
        patch.setattr("hma_jax.evaluation.parts.Parts", partial(Stopped, every=0))
        assert main([*command, "--to", str(to)]) == 130
    assert sorted(p.name for p in (to / "evaluating").iterdir()) == ["0.npz", "made_from"]
    sent.clear()
    assert main([*command, "--to", str(to)]) == 0 and not (to / "evaluating").exists()
    assert len(sent) == len(WindowTable.load(to / "windows.parquet")) - 1, "the first was not measured again"
    for name in ("evaluation.json", "evaluation.made_from.json"):
        assert (to / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.parametrize("other", ["size of a batch", "weights"])
def test_an_evaluation_does_not_go_on_after_what_was_measured_with_another(other, study, tmp_path, monkeypatch):
    """The stamp of its results is the same."""
    out, data = study
    run, size = shutil.copytree(out / "model", tmp_path / "run"), 1
    command = ["evaluate", str(run), *SMOKE, "--out", str(out), *map(str, data), "--set"]
    with monkeypatch.context() as patch:
        patch.setattr("hma_jax.evaluation.parts.Parts", partial(Stopped, every=0))
        assert main([*command, "eval.batch=1"]) == 130 and (run / "evaluating" / "0.npz").exists()
    if other == "weights":  # of the same step: it was trained again
        (run / "checkpoints" / "3" / "other").touch()
        write_list(run / "checkpoints" / "3")
    else:
        size = 2
    sent, put = [], evaluation._put
    monkeypatch.setattr(evaluation, "_put", lambda *batch: sent.append(batch) or put(*batch))
    assert main([*command, f"eval.batch={size}"]) == 0
    windows = sum(len(d.windows) for d in EvalManifest.load(Workspace(out).manifest).datasets)
    assert len(WindowTable.load(run / "windows.parquet")) == windows and len(sent) == -(-windows // size)
