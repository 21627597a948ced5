"""The real thing, small: from nothing to CSV, figures and page, through processes and kills."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import experiments
from experiments.analysis.rows import curve, read_csv
from experiments.running.closure import closure_hash
from experiments.running.provenance import read_record, trial_closure


def hma(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "experiments.cli", *arguments]


def finish(command: list[str], **where) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, **where)
    assert done.returncode == 0, done.stdout + done.stderr


def starts(out: Path) -> int:
    return sum(json.loads(line)["event"] == "running" for line in (out / "ledger.jsonl").read_text().splitlines())


@pytest.mark.beside
def test_one_command_goes_from_nothing_to_a_page(tmp_path):
    """Not marked slow, though it takes half a minute: the only fast test of the whole chain."""
    finish(hma("sweep", "trajectories", "--preset", "smoke", "--out", str(tmp_path), "--set", "trajectory_counts=4"))
    rows = read_csv(tmp_path / "results.csv")
    assert {(r.role, r.status) for r in rows} == {(r, "finished") for r in ("point", "control", "untrained")}
    (untrained,) = curve(rows, "trajectories", "perplexity", "untrained")
    assert untrained.mean == pytest.approx(256, rel=0.02)  # the vocabulary of the smoke tokenizer
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png") == 1 + 3 * 3
    closures = [record for path in (tmp_path / "trials").iterdir() if (record := read_record(path))]
    assert {record.code for record in closures} == {closure_hash(trial_closure())} == {r.code for r in rows}
    assert [record.besides for record in closures] == [{}, {}]  # the closure is all that was imported


@pytest.fixture
def copied(tmp_path_factory) -> dict:
    """Where a command runs a copy of the sources. Rows name the sources that made them, and trials refuse to run where
    these changed since their study began, as they do in a repository that somebody works in meanwhile."""
    here, there = Path(experiments.__file__).parents[1], tmp_path_factory.mktemp("sources")
    for package in ("hma_jax", "data_pipelines", "experiments"):
        left_out = shutil.ignore_patterns("__pycache__", "results")
        shutil.copytree(here / package, there / package, ignore=left_out)
    (there / "experiments" / "results").symlink_to(here / "experiments" / "results")  # the page reads of it
    return {"cwd": there, "env": os.environ | {"PYTHONPATH": str(there)}}


@pytest.mark.slow
def test_killed_study_ends_with_the_same_csv(tmp_path, copied):
    """kill -9 in the middle, the same command again: nothing runs twice, a trial that is made
    again gives the same bytes."""
    command = hma("study", "--preset", "smoke", "--out", str(tmp_path))
    study = subprocess.Popen(command, start_new_session=True, **copied)
    deadline = time.monotonic() + 400
    while not ((tmp_path / "ledger.jsonl").exists() and starts(tmp_path) == 2):
        assert time.monotonic() < deadline and study.poll() is None
        time.sleep(0.2)
    time.sleep(3)
    os.kill(study.pid, signal.SIGKILL)
    study.wait()

    finish(command, **copied)
    csv = (tmp_path / "results.csv").read_bytes()
    assert starts(tmp_path) == 6  # five trials, one of them twice
    finish(command, **copied)
    assert starts(tmp_path) == 6 and (tmp_path / "results.csv").read_bytes() == csv

    ledger = map(json.loads, (tmp_path / "ledger.jsonl").read_text().splitlines())
    (lost,) = (line["trial"] for line in ledger if line["event"] == "lost")
    shutil.rmtree(tmp_path / "trials" / lost)  # never killed, this time
    finish(command, **copied)
    assert starts(tmp_path) == 7 and (tmp_path / "results.csv").read_bytes() == csv


@pytest.mark.slow
def test_a_study_that_is_judged_otherwise_trains_nothing_again(tmp_path, copied):
    command = hma("sweep", "trajectories", "--preset", "smoke", "--out", str(tmp_path), "--set", "trajectory_counts=4")
    finish(command, **copied)
    before = {p.name: json.loads((p / "result.json").read_text()) for p in (tmp_path / "trials").iterdir()}
    finish([*command, "--set", "eval.random_actions=3", "--replace", "study"], **copied)
    now = [
        json.loads((path / "result.json").read_text())
        for path in (tmp_path / "trials").iterdir()
        if path.name not in before
    ]
    assert len(now) == len(before) == 2 and {one["run"]["train_seconds"] for one in now} == {0.0}

    def of(results):
        return sorted((one["training_loss"]["mean"], str(stats["perplexity"])) for one in results
                      for stats in one["evaluation"].values())  # fmt: skip

    assert of(now) == of(before.values())  # of the recorded actions: the models are the same
