"""Runs and checkpoints that are damaged, of another kind, or of another study."""

from __future__ import annotations

import gc
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from data_pipelines.windows.evalset import EvalManifest
from experiments.cli.main import main
from experiments.running.provenance import InputsChanged
from experiments.running.run_trial import open_prepared_data, run_trial
from experiments.running.workspace import Workspace
from hma_jax.config import require
from hma_jax.convert import read_official, write_run
from hma_jax.evaluation import evaluate as evaluation
from hma_jax.evaluation.parts import Parts
from hma_jax.evaluation.windows import WindowTable
from hma_jax.training.hashes import write_list
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.idle import ARM, BASE, SMOKE
from tests.hma_jax.convert.fakes import DISCRETE, make_checkpoint


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


@pytest.mark.parametrize("changed", ["store", "manifest", "tokenizer"])
def test_a_trial_does_not_run_on_other_data_than_it_was_planned_with(changed, study, tmp_path):
    """As with a tokenizer of the same shape that took the place of the study's during a sweep."""
    workspace = Workspace(study[0])
    inputs = open_prepared_data(workspace).provenance()
    assert open_prepared_data(workspace, inputs).provenance() == inputs
    planned, trial = replace(inputs, **{changed: "0ther"}), None
    with pytest.raises(
        InputsChanged, match=r"data changed since this sweep was started: \S+ is \w+, not 0ther\."
    ) as error:
        run_trial(trial, planned, workspace, tmp_path)
    assert f"{getattr(workspace, changed)} is {getattr(inputs, changed)}" in str(error.value)
    assert not list(tmp_path.iterdir())


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
def test_a_checkpoint_that_was_damaged_before_it_was_listed(command, name, study, tmp_path, refused):
    """What Orbax finds is all there is to say."""
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    for file in (run / "checkpoints" / "3").rglob(name):
        file.write_bytes(file.read_bytes()[:-30])
    write_list(run / "checkpoints" / "3")
    run_argument = (run,) if command == "evaluate" else ("--run", run)
    message = refused(2, command, *run_argument, *SMOKE, "--out", out, *data)
    assert f"{run / 'checkpoints' / '3'} cannot be read" in message and "remove this directory" in message
    gc.collect()  # what the readers left behind complains here, not in another test


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
