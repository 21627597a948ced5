"""Calls in a process of their own, and studies that prepare in one so that their trials find the accelerators free."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, UnreachableError
from data_pipelines.registry import find_spec, get_spec, register
from data_pipelines.registry import table as registry_table
from data_pipelines.sources.convertible import UnitError
from experiments import run_study
from experiments.cli.main import main
from experiments.running.slots import Accelerators
from experiments.running.subprocess_call import _portable, call_in_subprocess
from experiments.running.workspace import Busy
from experiments.study_setup import StudyArguments, make_setup
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit, Terminated, sigterm_as_interrupt
from hma_jax.runtime.locks import Holder
from hma_jax.training.checkpoints import SaveError
from hma_jax.training.divergence import DivergedError
from hma_jax.training.loop import Interrupted
from hma_jax.training.reading import CheckpointError
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.experiments.called_in_subprocess import end_by, fail, work_until_asked


def test_the_process_has_ended_when_its_answer_is_there():
    process = call_in_subprocess("asks", os.getpid)
    assert process != os.getpid()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


ERRORS = [
    ConfigError("wrong"), CheckpointError("another"), DataError("bad"), UnreachableError("no disk"), UnitError("units"),
    EpisodeError("an episode").at(Path("a.tfrecord"), 7), CorruptRecordError("a.tfrecord", 7, "a bit"),
    Busy("in use", Holder(3, "host", "today")), Interrupted("saved", Exit.STOPPED), SaveError("no space"),
    DivergedError("nan"), FileNotFoundError(2, "No such file or directory", "x"), BrokenPipeError(32, "Broken pipe"),
]  # fmt: skip


def test_errors_are_sent_as_they_are():
    for error in ERRORS:
        sent = pickle.loads(pickle.dumps(_portable(error)))
        assert type(sent) is type(error) and str(sent) == str(error)
        kept = [{name: value for name, value in vars(one).items() if name != "__notes__"} for one in (sent, error)]
        assert kept[0] == kept[1]


def test_an_error_that_cannot_be_sent_keeps_its_words_and_its_traceback():
    with pytest.raises(RuntimeError) as raised:
        call_in_subprocess("fails", fail)
    assert str(raised.value) == "Unsendable: three 3"
    (note,) = raised.value.__notes__
    assert "in fail" in note


def test_a_process_that_is_killed_is_an_error_that_says_so():
    with pytest.raises(ChildProcessError, match="the process that counts was ended by SIGKILL, perhaps for lack of"):
        call_in_subprocess("counts", end_by, signal.SIGKILL)


@pytest.mark.parametrize(
    ("number", "saves", "kind"),
    [
        (signal.SIGINT, False, KeyboardInterrupt),
        (signal.SIGTERM, False, Terminated),
        (signal.SIGTERM, True, Interrupted),
    ],
)
def test_a_request_to_stop_is_passed_on_and_nothing_is_left(number, saves, kind, tmp_path):
    started = tmp_path / "started"

    def ask() -> None:
        while not started.exists():
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    threading.Thread(target=ask, daemon=True).start()
    with sigterm_as_interrupt(), pytest.raises(kind) as raised:
        call_in_subprocess("waits", work_until_asked, started, saves)
    assert raised.type is kind and (not saves or raised.value.exit == Exit.STOPPED)
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)


# --- Studies -------------------------------------------------------------------------------------


STUDY = """
import sys
from jax._src import xla_bridge
from experiments import run_study
from experiments.cli.main import main
from experiments.running import slots

def run_jobs(jobs, *_):
    print(len(jobs), "trials, devices taken:", xla_bridge.backends_are_initialized())
    raise SystemExit(0)

run_study.run_jobs = run_jobs
kind = "gpu" if slots._jax_uses("gpu") else "cpu"  # what JAX computes on here
run_study.find_accelerators = lambda: slots.Accelerators(kind, ("0",))
main(sys.argv[1:])
"""


@pytest.mark.beside
def test_a_study_has_given_back_its_accelerators_when_its_trials_begin(tmp_path):
    arguments = [
        "sweep", "trajectories", "--preset", "smoke", "--out", str(tmp_path / "out"),
        "--data", str(write_rlds(tmp_path, get_spec("berkeley_gnm_cory_hall"), [12] * 6)),
        "--set", "trajectory_counts=4", "--set", "tokenizer_train.steps=2",
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    done = subprocess.run(
        [sys.executable, "-c", STUDY, *arguments], capture_output=True, text=True, timeout=300,
        env=environment | {"CUDA_VISIBLE_DEVICES": "0"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "done train the tokenizer" in done.stdout  # what goes on there is seen
    assert done.stdout.splitlines()[-1] == "2 trials, devices taken: False"


@pytest.mark.parametrize(
    ("found", "words"),
    [(None, "cannot hold checkpoints"), (Accelerators("cpu", ("0",)), "cannot hold checkpoints"),
     (Accelerators("gpu", ("0",)), "a GPU is expected, but JAX computes on cpu; check its driver")],
)  # fmt: skip
def test_an_error_of_preparing_is_the_same_wherever_that_is_done(found, words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run_study, "find_accelerators", lambda: found)
    monkeypatch.delenv("JAX_PLATFORMS")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    out = tmp_path / "a[1]"
    assert main(["study", "--preset", "smoke", "--out", str(out)]) == Exit.REFUSED
    said = capsys.readouterr().err
    assert (
        said.startswith("error: ") and said.count("\n") == 1 and words in said and (words[0] == "a" or str(out) in said)
    )


def test_entries_of_the_user_are_known_where_a_study_is_prepared(tmp_path, monkeypatch):
    calls, mine = [], make_spec("mine", (4,))
    register([mine])
    monkeypatch.setattr(run_study, "find_accelerators", lambda: Accelerators("tpu", ("0",)))
    monkeypatch.setattr(run_study, "call_in_subprocess", lambda what, *call: calls.append(call))
    setup = make_setup(StudyArguments("smoke", tmp_path, set=("datasets=mine", "dataset_counts=1")))
    monkeypatch.setattr(run_study, "require_accelerator", lambda kind: calls.append(kind))
    run_study.prepare_apart(setup, None)
    ((function, *arguments),) = calls
    registry_table._registered.clear()  # as in another process
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: find_spec("mine"))
    assert function(*arguments) == mine and calls[1:] == ["tpu"]
