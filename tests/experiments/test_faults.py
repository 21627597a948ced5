"""What the program does when it is told to stop, meets numbers that are none, or finds another process at work."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from data_pipelines.errors import UnreachableError
from data_pipelines.tokens import part_maker
from experiments.analysis.tables import read_side
from experiments.cli.main import main
from experiments.run_study import require_results
from experiments.running import run_trial as trials
from experiments.running import trial_main
from experiments.running.attempts import AttemptEnd, State, outcome
from experiments.running.provenance import InputsChanged
from experiments.running.runner import Job
from experiments.running.shared_runs import SharedTraining
from experiments.running.workspace import Workspace
from experiments.terminal.exit_code import TrialsFailed
from hma_jax.runtime.exits import Exit
from hma_jax.training import train as model_training
from hma_jax.training.log import RunLog
from hma_jax.training.reading import find_damage, list_steps
from hma_jax.training.run_lock import EVALUATION, locked_run
from hma_jax.training.runs import load_model, load_run
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.idle import ARM, LENGTHS, SMOKE, idle_training  # noqa: F401
from tests.full_disk import full_disk

ROOT = Path(__file__).parents[2]

STEPS = ("--set", "tokenizer_train.steps=4", "--set", "train.steps=4")


@pytest.fixture(scope="module")
def where(tmp_path_factory) -> tuple[str, ...]:
    root = tmp_path_factory.mktemp("faults")
    data = write_rlds(root, ARM, LENGTHS)
    return (*SMOKE, "--out", str(root / "out"), "--data", str(data), *STEPS)


@pytest.fixture(scope="module")
def study(where) -> Path:
    """A prepared study with a trained and evaluated model, in `model`."""
    out = Path(where[3])
    assert main(["train", *where, "--checkpoint-every", "1"]) == 0
    assert main(["evaluate", str(out / "model"), *where]) == 0
    return out


# --- Asked to stop ---------------------------------------------------------------------------


def asked_at(
    monkeypatch: pytest.MonkeyPatch, owner: object, name: str, call: int, number: signal.Signals = signal.SIGTERM
) -> None:
    """The signal arrives when `owner.name` is called for the `call`-th time."""
    real, calls = getattr(owner, name), []

    def function(*arguments, **options):
        calls.append(name)
        if len(calls) == call:
            os.kill(os.getpid(), number)
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, function)


LONG = {
    "tokenizer train": (RunLog, "write", 2),
    "tokenize": (part_maker, "write_part", 1),
    "train": (RunLog, "write", 2),
    "evaluate": (trials, "write_evaluation", 1),
}


@pytest.mark.slow
def test_sigterm_ends_every_long_command_with_one_code_and_it_goes_on(where, tmp_path, monkeypatch, capsys):
    where = (*where[:3], str(tmp_path / "out"), *where[4:])
    model = str(tmp_path / "out" / "model")
    for command, moment in LONG.items():
        arguments = [*command.split(), *((model,) if command == "evaluate" else ()), *where]
        with monkeypatch.context() as patch:
            asked_at(patch, *moment)
            assert main(arguments) == Exit.STOPPED == 143, command
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "the same command" in said, said
        runs = list((tmp_path / "out").glob("tokenizer.*")) if command == "tokenizer train" else [Path(model)]
        if "train" in command:
            (run,) = runs
            (step,) = list_steps(run / "checkpoints")[-1:]
            assert 2 <= step < 4 and find_damage(run / "checkpoints" / str(step)) is None
            assert (run / "checkpoints" / str(step) / "sha256.json").exists(), "the save was not awaited"
        if command == "evaluate":
            assert not (Path(model) / "evaluation.json").exists()
        assert main(arguments) == 0, command
        if "train" in command:
            place = tmp_path / "out" / "tokenizer" if command == "tokenizer train" else run
            starts = [json.loads(line)["resumed_from"] for line in (place / "execution.jsonl").read_text().splitlines()]
            assert starts == [0, step]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_each_signal_has_its_own_code_while_training(number, where, study, tmp_path, monkeypatch, capsys):
    asked_at(monkeypatch, RunLog, "write", 1, number)
    assert main(["train", *where, "--run", str(tmp_path / "run")]) == 128 + number
    assert "the same command resumes from" in capsys.readouterr().err


def test_a_trial_that_is_asked_to_stop_while_it_evaluates_says_so(tmp_path, monkeypatch):
    def asked(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)

    write_job(tmp_path, monkeypatch)
    monkeypatch.setattr(trials, "run_trial", asked)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert trial_main.main(tmp_path) == Exit.STOPPED
    finally:
        signal.signal(signal.SIGTERM, before)


def write_job(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a trial of nothing."""
    inputs = {"store": "a", "manifest": "b", "tokenizer": "c"}
    (directory / "job.json").write_text(json.dumps({"provenance": inputs}))
    monkeypatch.setattr(
        "experiments.running.job.read_job", lambda record: (SimpleNamespace(source=None), None, SharedTraining())
    )


def test_a_trial_whose_data_is_not_what_it_was_planned_with_is_refused(tmp_path, monkeypatch):
    """It was filed under the name of the other data."""

    def other(*_, **__):
        raise InputsChanged("tokenizer is a, not c")

    write_job(tmp_path, monkeypatch)
    monkeypatch.setattr(trials, "run_trial", other)
    assert trial_main.main(tmp_path) == Exit.REFUSED
    state = outcome(tmp_path, AttemptEnd(Exit.REFUSED))
    assert state == State("refused", "tokenizer is a, not c")
    with pytest.raises(TrialsFailed, match="To try them again: hma study$"):  # without --accept-code
        require_results([Job("a", "trial", {})], {"a": state}, "hma study", False)


# --- A full disk -----------------------------------------------------------------------------


@pytest.mark.parametrize("room", [0, 400], ids=["not a byte", "enough to say so"])
def test_a_trial_on_a_full_disk_is_lost_not_failed_so_that_the_same_command_goes_on(room, tmp_path, monkeypatch):
    write_job(tmp_path, monkeypatch)
    with full_disk(room):
        assert trial_main.main(tmp_path) == Exit.LOST  # its provenance.json takes more
    state = outcome(tmp_path, AttemptEnd(Exit.LOST))
    assert state.event == "lost"
    assert ("provenance.json" if room else "is the disk full?") in state.message


def test_the_process_of_a_trial_takes_no_option_for_a_directory(tmp_path):
    """--help was made, and held the start of an attempt."""
    asked = [sys.executable, "-m", "experiments.running.trial_main", "--help"]
    where = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(ROOT)}}
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60, **where)
    assert done.returncode == 0 and "trial_main.py [-h] DIRECTORY" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_trial_whose_data_cannot_be_read_now_is_lost_not_failed(tmp_path, monkeypatch):
    def away(*_, **__):
        raise UnreachableError("tokens/arm: cannot be read (Stale file handle)")

    write_job(tmp_path, monkeypatch)
    monkeypatch.setattr(trials, "run_trial", away)
    assert trial_main.main(tmp_path) == Exit.LOST
    assert outcome(tmp_path, AttemptEnd(Exit.LOST)) == State("lost", "tokens/arm: cannot be read (Stale file handle)")


# --- Not finite ------------------------------------------------------------------------------


def test_a_loss_that_is_no_number_has_its_own_code_and_names_the_records(where, study, tmp_path, monkeypatch, capsys):
    def step(*_):
        def diverging(state, batch):
            loss = jnp.where(state.step == 2, jnp.nan, 5.0)
            return state._replace(step=state.step + 1), {"loss": loss}

        return diverging

    monkeypatch.setattr(model_training, "make_train_step", step)
    run = tmp_path / "run"
    capsys.readouterr()
    assert main(["train", *where, "--run", str(run), "--checkpoint-every", "1"]) == Exit.DIVERGED == 3
    said = capsys.readouterr().err
    assert said.startswith("error: the loss is nan at step 3; its batch was ")
    assert f"{ARM.name}: {ARM.name}-train.tfrecord-00000-of-00001, episode " in said and "Traceback" not in said
    record = json.loads((run / "diverged.json").read_text())
    assert record["step"] == 3 and len(record["records"]) == 4 and record["records"][0] in said
    assert list_steps(run / "checkpoints") == [1, 2]


# --- Another process -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command", ["study", "sweep width", "data suite", "tokenizer train", "train", "tokenize --replace tokens"]
)
def test_a_directory_that_another_command_works_in_is_refused(command, tmp_path, capsys):
    with Workspace(tmp_path).locked():
        assert main([*command.split(), *SMOKE, "--out", str(tmp_path)]) == Exit.REFUSED
    said = capsys.readouterr().err
    assert said.startswith(f"error: another command is using {tmp_path} (process {os.getpid()} on ")


def test_two_evaluations_of_one_run_are_refused(where, study, capsys):
    evaluate = ["evaluate", str(study / "model"), *where]
    before = (study / "model" / "evaluation.json").read_bytes()
    with locked_run(study / "model", EVALUATION):
        assert main(evaluate) == Exit.REFUSED
    assert f"{study / 'model'} is being evaluated by process {os.getpid()} on " in capsys.readouterr().err
    assert (study / "model" / "evaluation.json").read_bytes() == before


def test_results_of_other_windows_or_settings_are_kept_unless_told_otherwise(
    where, study, tmp_path, monkeypatch, capsys
):
    run, other = study / "model", ("--set", "eval.perplexity_group=2")
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    assert main(["evaluate", str(run), *where, *other]) == Exit.REFUSED
    said = capsys.readouterr().err
    assert (
        "eval.perplexity_group: 1 -> 2\n" in said and "--to DIR, or overwrite the existing ones with --replace" in said
    )
    assert main(["evaluate", str(run), *where, *other, "--to", str(tmp_path / "beside")]) == 0
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before
    assert {"evaluation.json", "windows.parquet", "samples.npz"} < {p.name for p in (tmp_path / "beside").iterdir()}
    assert read_side(tmp_path / "beside").tokenizer == read_side(run).tokenizer != ""
    before = {path.name: path.read_bytes() for path in (tmp_path / "beside").iterdir() if path.is_file()}
    with monkeypatch.context() as patch:  # before all is written
        asked_at(patch, trials, "write_evaluation", 1)
        assert main(["evaluate", str(run), *where, "--replace", "--to", str(tmp_path / "beside")]) == Exit.STOPPED
    assert {path.name: path.read_bytes() for path in (tmp_path / "beside").iterdir() if path.is_file()} == before


def test_a_model_that_is_being_trained_may_be_evaluated(where, study):
    with locked_run(study / "model"):
        assert main(["evaluate", str(study / "model"), *where]) == 0


# --- Reading ---------------------------------------------------------------------------------


def snapshot(run: Path) -> dict[str, tuple[str, int]]:
    files = [p for p in (run / "checkpoints").rglob("*") if p.is_file()]
    return {str(p): (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns) for p in files}


def test_a_checkpoint_is_not_touched_by_reading_it(where, study, capsys):
    run = study / "model"
    before = snapshot(run)
    assert {Path(p).relative_to(run / "checkpoints").parts[0] for p in before} == {"3", "4"}
    load_run(run)
    load_model(run)
    assert main(["evaluate", str(run), *where]) == 0
    assert main(["train", *where, "--keep-checkpoints", "1"]) == 0  # it is trained to its end
    assert main(["train", *where, "--set", "tau=2"]) == Exit.REFUSED  # it is another's
    assert main(["train", *where, "--skip-damaged"]) == 0  # nothing is damaged
    assert snapshot(run) == before
