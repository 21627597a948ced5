"""Whoever gives data learns, before anything is made of it, how large a model is trained, and on how much of it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from data_pipelines.registry import get_spec
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from experiments.cli.main import main
from experiments.data_size import size_by_entry, size_of
from experiments.dry_run.cost import count_parameters
from experiments.dry_run.notes import say_scale
from experiments.dry_run.preparing_cost import count_frames, estimate_preparing
from experiments.presets import ON_ACCELERATORS, PRESETS
from experiments.running.slots import Accelerators
from experiments.running.workspace import Record, Workspace, save_record
from experiments.study import on_user_data
from experiments.study_setup import StudyArguments, StudySetup, count_again, make_setup
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.experiments.fakes import PROVENANCE


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})


def declare(directory: Path, episodes: int) -> None:
    """Has an RLDS directory say that it holds so many."""
    info = json.loads((directory / "dataset_info.json").read_text())
    info["splits"][0]["shardLengths"] = [str(episodes)]
    (directory / "dataset_info.json").write_text(json.dumps(info))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> list[str]:
    """A dataset of four episodes whose files say that it has 95,000, and one of which they say four."""
    root, specs = tmp_path_factory.mktemp("data"), [make_spec("large"), make_spec("small")]
    places = [str(write_rlds(root, spec, [30] * 4)) for spec in specs]
    declare(Path(places[0]), 95_000)
    (root / "my.toml").write_text("".join(map(to_toml, specs)))
    return ["--data", *places, "--registry", str(root / "my.toml")]


def said_by(capsys, *words: str) -> list[str]:
    assert main(list(words)) == 0
    return notes(capsys)


def notes(capsys) -> list[str]:
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]


def test_a_dry_run_says_what_the_default_preset_is_made_for(data, capsys, tmp_path):
    out = ["--out", str(tmp_path)]
    first, second, _ = said_by(capsys, "study", "--dry-run", *data, *out)
    assert re.fullmatch(
        r"note: preset cpu trains models of up to [\d.]+ [kM] parameters on images of 32 x 32 pixels, for 2,500 steps of "
        r"4 windows, with at most 500 trajectories of each dataset\. It is made for a processor: on a GPU or TPU take "
        r"--preset accelerator",
        first,
    )
    every = "4,32,500,95000"
    assert second == (
        "note: large has 95,000 trajectories, of which a trial takes 500 at most; to use all, with one more point on the "
        f"axis trajectories: --set trajectory_counts={every}"
    )
    (alone,) = said_by(capsys, "sweep", "width", "--dry-run", *data, *out, "--set", f"trajectory_counts={every}")
    assert "with at most 95,000 trajectories of each dataset" in alone
    (model,) = said_by(capsys, "train", "--dry-run", *data, *out)
    assert "trains a model of" in model and "with all trajectories of each dataset" in model
    (model,) = said_by(capsys, "train", "--dry-run", *data, *out, "--trajectories", "7")
    assert "with at most 7 trajectories" in model
    assert "large (4 Hz, not 5)" in said_by(capsys, "train", "--dry-run", *data, *out, "--set", "rate=5")[0]


@pytest.mark.parametrize("command", ["study", "sweep width", "train"])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"image_key": "observation/image_9"}, "no image 'observation/image_9'"),
        ({"action_dims": (3,)}, "has 2 values per step"),
        ({"split": "test"}, "no split 'test'"),
    ],
)
def test_a_dry_run_refuses_an_entry_that_cannot_read_the_data(command, wrong, message, capsys, tmp_path, monkeypatch):
    """Without finding its records, which takes long the first time."""

    def read(*_, **__):
        raise AssertionError("a record was looked for")

    monkeypatch.setattr("data_pipelines.sources.rlds.dataset.load_index", read)
    spec, file = make_spec("mine", (2,)), tmp_path / "my.toml"
    data = [
        "--data",
        str(write_rlds(tmp_path, spec, [30] * 4)),
        "--registry",
        str(file),
        "--out",
        str(tmp_path / "out"),
    ]
    file.write_text(to_toml(spec))
    assert main([*command.split(), "--dry-run", *data]) == 0
    file.write_text(to_toml(replace(spec, **wrong)))
    assert main([*command.split(), "--dry-run", *data]) == 2
    assert message in capsys.readouterr().err


def test_held_out_trajectories_are_not_called_unused(data, capsys, tmp_path):
    """Of the 95,000 that there are, 200 are held out."""
    words = ("sweep", "width", "--dry-run", *data, "--out", str(tmp_path), "--set")
    assert len(said_by(capsys, *words, "trajectory_counts=94800")) == 1
    assert len(said_by(capsys, *words, "trajectory_counts=94799")) == 2


def test_a_dry_run_plans_with_the_part_of_a_dataset_that_is_tokenised(data, capsys, tmp_path):
    """The 200 that are held out of 95,000 come on top."""
    words = ("sweep", "width", "--dry-run", *data, "--out", str(tmp_path), "--set")
    (scale,) = said_by(capsys, *words, "store.max_train=100")  # none that a trial would not use
    assert "with at most 100 trajectories of each dataset" in scale
    directories, registry = tuple(data[1:3]), Path(data[-1])
    study = make_setup(StudyArguments("cpu", tmp_path, directories, registry, set=("store.max_train=100",))).study
    sizes = [size_of(get_spec(name), study.store.held_out) for name in ("large", "small")]
    assert [(size.episodes, size.tokenised, size.trained) for size in sizes] == [(95_000, 300, 100), (4, 4, 3)]
    assert size_by_entry(replace(get_spec("large"), episodes=1000), study.store.held_out).tokenised == 150


def test_it_is_said_which_points_an_axis_does_not_have(capsys, tmp_path):
    """A curve that is flat because its points have the same data, or of one point, is no result."""
    specs, file = (
        [replace(make_spec(name), episodes=n) for name, n in (("mine", 8), ("yours", 5))],
        tmp_path / "my.toml",
    )
    file.write_text("".join(map(to_toml, specs)))
    data = [
        "--data",
        *(str(write_rlds(tmp_path, spec, [30] * spec.episodes)) for spec in specs),
        "--registry",
        str(file),
    ]
    words = ("study", "--dry-run", *data, "--out", str(tmp_path / "out"))
    caps, counts = said_by(capsys, *words)[1:]
    assert caps == (
        "note: no dataset has more than 6 trajectories to train on, so the axis trajectories has 4 and "
        "500, without 32, which would train on the same; for other points: --set trajectory_counts=2,3,6"
    )
    assert counts == (
        "note: the axis datasets has one point, with all 2 datasets; for more, all judged on 1 dataset: --set "
        "dataset_counts=1,2"
    )
    assert len(said_by(capsys, *words, "--set", "axes=width")) == 1
    assert len(said_by(capsys, *words, "--set", "trajectory_counts=2,4,8", "--set", "dataset_counts=1,2")) == 1
    _, chosen = said_by(capsys, *words, "--set", "trajectory_counts=4,32,500", "--set", "dataset_counts=2")
    assert chosen == caps


@pytest.mark.parametrize("name", ["fractal20220817_data", "language_table"])
def test_plans_count_the_episodes_of_the_files_not_those_that_were_published(name, capsys, tmp_path):
    """Points were planned, and trained, for 87,212 trajectories where there were nine."""
    spec = replace(get_spec(name), image_key="observation/image", action_keys=("action",), action_dims=(3,))
    directory, file, out = write_rlds(tmp_path, spec, [40] * 12), tmp_path / "my.toml", tmp_path / "out"
    file.write_text(to_toml(spec))
    words = ("--data", str(directory), "--registry", str(file), "--out", str(out), "--preset", "smoke")
    assert (
        main(
            [
                "sweep",
                "trajectories",
                "--dry-run",
                *words,
                "--set",
                "trajectory_counts=4,8,9,100,500",
                "--set",
                "rate=1",
            ]
        )
        == 0
    )
    plan = capsys.readouterr().out
    said = " ".join(plan.split())
    assert f"not of the registry's entries: {name} has 12 (not {spec.episodes:,})" in said
    assert said.count(f"{spec.episodes:,}") == 1 and "to use all" not in said
    assert "no dataset has more than 10 trajectories to train on, so the axis trajectories has 4, 8, 9 and 500" in said
    short = "The entry of language_table is of other episodes: `hma data inspect DIR` measures yours"
    assert (short in said) == (name == "language_table")
    found = make_setup(StudyArguments("smoke", out, (str(directory),), file))
    cost = estimate_preparing(found.study)
    frames = count_frames(found.study, name)
    assert frames.native == 12 * spec.mean_steps and cost.tokens < 1


def test_points_that_are_the_same_trial_run_once(capsys, tmp_path):
    """Which ones are, the tokens say at last: some episodes are too short for a window."""
    spec, file, out = make_spec("mine"), tmp_path / "my.toml", tmp_path / "out"
    directory = write_rlds(tmp_path, spec, [30] * 9 + [2] * 3)
    file.write_text(to_toml(spec))
    where = StudyArguments("smoke", out, (str(directory),), file, set=("trajectory_counts=4,7,9,100",))
    setup = make_setup(where)
    assert setup.study.trajectory_counts == (4, 7, 9, 100)  # ten are not held out, by the files
    out.mkdir()
    (out / "data.json").write_text(json.dumps({"mine": {"episodes": 9, "too_short": 2, "held_out": 3, "skipped": 0}}))
    assert count_again(setup).study.trajectory_counts == make_setup(where).study.trajectory_counts == (4, 100)
    save_record(setup.workspace, Record(setup.study, provenance=PROVENANCE))  # of an earlier version, which goes on
    assert make_setup(where).study.trajectory_counts == (4, 7, 9, 100)
    for caps in "4,1000", "4,100,1000", "4,8,100":  # its trial with at most 100 has all of them too
        assert make_setup(replace(where, set=(f"trajectory_counts={caps}",))).study == make_setup(where).study
    assert make_setup(replace(where, set=("trajectory_counts=4,6",))).study.trajectory_counts == (4, 6)
    assert make_setup(replace(where, set=("trajectory_counts=2,500",))).study.trajectory_counts == (2, 100)
    declare(directory, 30)  # more were added since, of which no tokens were made
    (out / "study.json").unlink()
    assert make_setup(where).study.trajectory_counts == (4, 7, 9, 100)


def test_what_is_made_for_an_accelerator_names_no_other(data, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.dry_run.plan_table.plan_table", lambda *_, **__: "")
    first, *_ = said_by(capsys, "study", "--dry-run", "--preset", "accelerator", *data, "--out", str(tmp_path))
    assert "for 20,000 steps of 64 windows, with at most 1,000 trajectories" in first and first.endswith("each dataset")


@pytest.mark.parametrize("command", [("study", "--launcher", "slurm"), ("train",)])
def test_a_dry_run_without_the_tokenizer_that_its_study_cannot_train_says_so(
    command, data, capsys, tmp_path, monkeypatch
):
    """It advised to train it elsewhere, which is refused."""
    monkeypatch.setattr("experiments.dry_run.plan_table.plan_table", lambda *_, **__: "")
    monkeypatch.setattr("experiments.dry_run.notes.find_accelerators", lambda: None)
    lines = said_by(capsys, *command, "--dry-run", "--preset", "paper", *data, "--out", str(tmp_path / "out"))
    (refused,) = [line for line in lines if "would be refused" in line]
    assert "cannot be trained here" in refused and "`hma tokenizer import`" in refused and "--tokenizer" in refused
    assert not any("no accelerator" in line for line in lines)


def test_a_tokenizer_that_would_be_trained_without_the_accelerators_of_the_trials_is_told(
    data, capsys, tmp_path, monkeypatch
):
    """`--launcher slurm` on a login node: the dry run prices hours of the processor as minutes of a GPU."""
    monkeypatch.setattr("experiments.dry_run.plan_table.plan_table", lambda *_, **__: "")
    monkeypatch.setattr("experiments.dry_run.notes.find_accelerators", lambda: None)
    out = tmp_path / "out"

    def told(preset: str, launcher: str) -> list[str]:
        words = ("study", "--dry-run", "--preset", preset, *data, "--out", str(out), "--launcher", launcher)
        return [line for line in said_by(capsys, *words) if "no accelerator" in line]

    (note,) = told("accelerator", "slurm")
    assert note.startswith(
        "note: the tokenizer would be trained on this machine, where no accelerator is found, for much longer than a dry "
        "run says. First run, on a machine that has one: hma tokenizer train --preset accelerator "
    )
    assert note.endswith(f"--registry {data[-1]}")
    assert not told("accelerator", "local") and not told("cpu", "slurm")
    (out / "tokenizer").mkdir(parents=True)
    assert not told("accelerator", "slurm")
    out = tmp_path / "other"
    monkeypatch.setattr("experiments.dry_run.notes.find_accelerators", lambda: Accelerators("gpu", ("0",)))
    assert not told("accelerator", "slurm")


def test_the_simulated_suite_needs_no_such_note(capsys, tmp_path):
    assert said_by(capsys, "train", "--preset", "smoke", "--dry-run", "--out", str(tmp_path)) == []


@pytest.mark.parametrize(("command", "lines"), [("study", 3), ("sweep width", 2), ("train", 1), ("tokenize", 1)])
def test_it_is_said_before_anything_is_made(command, lines, data, capsys, tmp_path, monkeypatch):
    def stop(*_, **__):
        raise ConfigError("stop here")

    monkeypatch.setattr("experiments.preparing.pipeline.prepare", stop)
    assert main([*command.split(), "--preset", "smoke", *data, "--out", str(tmp_path / "out")]) == 2
    said = notes(capsys)
    assert len(said) == lines and "take --preset accelerator" in said[0]


@pytest.mark.parametrize("command", ["train", "sweep width"])
@pytest.mark.parametrize("steps", [8990, 8991])
def test_a_decay_that_a_run_does_not_come_to_is_named(command: str, steps: int, capsys, tmp_path):
    """Runs that compare larger ones are equal to the bit."""
    settings = ["--set", "train.ema_decay=0.999", "--set", f"train.steps={steps}"]
    said = said_by(
        capsys, *command.split(), "--dry-run", "--preset", "smoke", *settings, "--out", str(tmp_path / "out")
    )
    named = [line for line in said if "does not come to train.ema_decay: 0.999 in 8,990 steps" in line]
    assert len(said) == len(named) == (steps == 8990)


def test_presets_for_a_processor_name_one_that_is_larger():
    for name, other in ON_ACCELERATORS.items():
        assert PRESETS[other].flops_per_second > 1e12 > PRESETS[name].flops_per_second
        assert PRESETS[other].model.width > PRESETS[name].model.width
        assert (PRESETS[other].model.diffusion is None) == (PRESETS[name].model.diffusion is None)


def test_of_trials_of_different_lengths_the_longest_is_named(capsys, tmp_path):
    setup = StudySetup(StudyArguments("cpu"), PRESETS["cpu"], (), Workspace(tmp_path), PRESETS["cpu"].trajectory_counts)
    short = reference_trial(PRESETS["cpu"], 0)
    long = replace(short, train=replace(short.train, steps=32_000))
    say_scale(setup, [short, long])
    assert "for up to 32,000 steps of 4 windows, with at most 500 trajectories" in " ".join(
        capsys.readouterr().out.split()
    )
    say_scale(setup, [long, replace(long, capped=long.datasets[:1])])
    assert "for 32,000 steps of 4 windows, with all trajectories" in " ".join(capsys.readouterr().out.split())


def test_the_page_says_how_large_the_models_are():
    page = " ".join((Path(__file__).parents[2] / "docs" / "own_data.md").read_text().split())
    for name, begin in (("cpu", "unless you say otherwise: "), ("accelerator", "take `--preset accelerator` (")):
        study = on_user_data(PRESETS[name], ["bridge_dataset"])
        millions, train = count_parameters(reference_trial(study, 0)) / 1e6, study.train
        assert f"{begin}{millions:.2g} M parameters" in page
        assert f"{train.steps:,} steps of {train.batch} windows" in page
        assert f"`{name}` {study.trajectory_counts[-1]:,}" in page


def test_parameters_are_those_of_the_dry_run(data, capsys, tmp_path):
    """The note gives the largest model of the table."""
    assert main(["sweep", "width", "--dry-run", *data, "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    (told,) = re.findall(r"models of up to ([\d.]+ [kM]) parameters", said)
    rows = [line for line in said.splitlines() if re.search(r"\b48\b", line) and told in line]
    assert rows, said
