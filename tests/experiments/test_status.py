"""`hma status`: what it says of trials that ran, run, failed and never began."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.cli.main import main
from experiments.running.attempts import FAILURE, PROGRESS, STARTED, attempt
from experiments.running.ledger import Ledger
from experiments.running.workspace import Workspace, command_at, save_record
from tests.experiments.fakes import finished_study, record_of


def said(capsys, *arguments: str) -> str:
    assert main(["status", *arguments]) == 0
    return " ".join(capsys.readouterr().out.split())


def test_trials_without_a_result_are_listed_with_what_they_do_and_why_they_ended(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    workspace = finished_study(tmp_path, broken={"width 8 · seed 0": "diverged", "width 8 · seed 1": "lost"})
    save_record(workspace, record_of())
    whole = said(capsys, str(tmp_path))
    assert "1 diverged, 1 lost" in whole and whole.count("the loss is <nan> at step 2") == 2
    assert "no command runs it; to go on: hma study" in whole
    assert "not begun" not in whole and "9 of 11 trials finished" in whole and "2 trajectories" not in whole
    assert "2 trajectories" in said(capsys, str(tmp_path), "--all")


def test_a_running_trial_says_where_it_is_and_for_how_long_it_said_nothing(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    workspace = finished_study(tmp_path)
    save_record(workspace, record_of())
    directory = next(workspace.trials.iterdir())
    (directory / "result.json").unlink()
    with attempt(directory):
        start = json.loads((directory / STARTED).read_text())
        (directory / PROGRESS).write_text(json.dumps({"phase": "training", "done": 1200, "total": 3000}))
        assert f"training 1,200 of 3,000 │ {start['host']} │" in said(capsys, str(tmp_path))
        monkeypatch.setattr("time.time", lambda: (directory / PROGRESS).stat().st_mtime + 600)
        assert f"{start['host']}, 10 min ago" in said(capsys, str(tmp_path))


@pytest.mark.parametrize("name", [PROGRESS, FAILURE])
def test_files_of_an_attempt_that_a_power_loss_emptied_are_not_shown(name, tmp_path: Path, capsys):
    """The command ended with a traceback."""
    workspace = finished_study(tmp_path)
    save_record(workspace, record_of())
    directory = next(workspace.trials.iterdir())
    (directory / "result.json").unlink()
    Ledger(workspace.ledger).append(directory.name, "running")
    (directory / name).touch()
    assert "10 of 11 trials finished" in said(capsys, str(tmp_path))


def test_a_directory_without_a_study_is_refused(tmp_path: Path, capsys):
    assert main(["status", str(tmp_path)]) == 2 and "no study in" in capsys.readouterr().err
    for name in ("model", "tokenizer", "tokenizer.b9de69a6423b9f76"):  # the last is of a tokenizer that is not finished
        (tmp_path / name / "checkpoints").mkdir(parents=True)
    assert main(["status", str(tmp_path)]) == 2
    assert "single runs of `hma train`, whose progress is in their metrics.jsonl: model;" in capsys.readouterr().err
    save_record(Workspace(tmp_path), record_of())
    assert "not begun" in said(capsys, str(tmp_path))


def test_a_study_whose_data_are_being_prepared_says_so(tmp_path: Path, capsys):
    with Workspace(tmp_path).locked():
        assert main(["status", str(tmp_path)]) == 2
    assert f"no trial yet: process {os.getpid()} on" in capsys.readouterr().err


def test_the_command_of_a_study_that_was_moved_names_where_it_is(tmp_path: Path, capsys, monkeypatch):
    """It named the old path, where it began another study."""
    monkeypatch.chdir(tmp_path)
    words = "hma study --preset smoke --out {0} --set axes=width,{0}/axes/own.py"
    there = replace(record_of(), command=words.format("/old/place"))
    assert command_at(Path("runs/a b"), there) == (
        "hma study --preset smoke --out 'runs/a b' --set 'axes=width,runs/a b/axes/own.py'"
    )
    here = replace(there, command=words.format(tmp_path / "new"))
    assert command_at(Path("new"), here) == here.command  # not moved
    plain = replace(there, command="hma study --preset smoke")
    assert command_at(Path("runs/smoke"), plain) == plain.command
    (tmp_path / "new").mkdir()
    save_record(Workspace(tmp_path / "new"), plain)
    assert "to go on: hma study --preset smoke --out new" in said(capsys, "new")


def test_no_command_is_named_where_what_is_missing_diverged(tmp_path: Path, capsys):
    workspace = finished_study(tmp_path, broken={"width 8 · seed 0": "diverged"})
    save_record(workspace, record_of())
    assert "1 diverged" in (whole := said(capsys, str(tmp_path))) and "to go on" not in whole
