"""Data that is damaged, of another kind than its entry says, or too short for a window."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.registry import get_spec
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.identity import EpisodeRun, episode_ids
from data_pipelines.tokens import tokenize_job
from experiments import data_size
from experiments.cli.main import main
from experiments.preparing import windows
from experiments.preparing.sources import say_short_episodes
from experiments.presets import get_preset
from experiments.running.workspace import Workspace
from hma_jax.config import require
from hma_jax.tokenizers import train as tokenizer_training
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.experiments.idle import ARM, BASE, LENGTHS, SMOKE


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


# --- Datasets --------------------------------------------------------------------------------


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
    assert "`hma data inspect DIR --entry FILE.toml` writes one" in message


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
    assert "`hma data convert robomimic FILE --out DIR --name NAME`" in message  # with one name, `joins` cannot help


# --- Windows ---------------------------------------------------------------------------------


def test_episodes_that_an_entry_says_are_too_short_are_told_before_a_tokenizer_is_trained(
    tmp_path, monkeypatch, capsys
):
    """How long each is, tokenising finds out. Without a word a tokenizer was trained for nothing."""
    arm = write_rlds(tmp_path / "rlds", ARM, LENGTHS)  # never tokenised
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: require(False, "it would be trained"))
    for steps, told in (8.0, True), (9.0, False), (0.0, False):  # 0: the entry does not say it
        monkeypatch.setattr(registry_table, "_registered", {ARM.name: replace(ARM, mean_steps=steps)})
        assert main(["tokenize", *SMOKE, "--out", str(tmp_path / "out"), "--data", str(arm)]) == 2
        said, note = capsys.readouterr(), f"{ARM.name} (about {steps:g} steps an episode; 9 are needed)"
        assert "it would be trained" in said.err and (note in said.out) == told
        assert main(["train", *SMOKE, "--out", str(tmp_path / "new"), "--data", str(arm), "--dry-run"]) == 0
        assert (note in capsys.readouterr().out) == told


def test_thousands_of_steps_are_written_out(monkeypatch, capsys):
    """They were "about 1.23e+03 steps"."""
    monkeypatch.setattr(data_size, "_known", {})
    spec = replace(ARM, hz=1000.0, mean_steps=1234.56)
    say_short_episodes(get_preset("smoke"), [(spec, Path())])
    assert f"{ARM.name} (about 1,234.6 steps an episode; 1,500 are needed)" in capsys.readouterr().out


def test_so_are_those_of_data_that_replace_others_of_which_windows_are_there(tmp_path, monkeypatch, capsys):
    arm = write_rlds(tmp_path / "rlds", ARM, LENGTHS)
    monkeypatch.setattr(tokenizer_training, "train_tokenizer", lambda *_, **__: require(False, "it would be trained"))
    monkeypatch.setattr(registry_table, "_registered", {ARM.name: replace(ARM, mean_steps=8.0)})
    Workspace(tmp_path).manifest.write_text("{}")
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
