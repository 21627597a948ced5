"""Runs the trials that are missing, each in its own process, and survives what happens to them.

A trial that crashes is recorded with its message and the others go on. The runner itself may
be interrupted or killed at any point: its children die with it, and the next run finishes the
trial that was cut short, from its checkpoint.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_pipelines.publishing.files import write_file
from experiments.running.children import child_environment
from experiments.running.ledger import DIVERGED, FAILED, FINISHED, INTERRUPTED, MISSING, REFUSED, STARTED, Ledger
from experiments.running.trial_main import FAILURE, JOB, PROGRESS, RESULT, STOPPED

GRACE_SECONDS = 60.0
"""How long a trial may take to save its state when the runner is interrupted."""


@dataclass(frozen=True)
class Job:
    """A trial to run: `record` is what its process reads from job.json."""

    id: str
    title: str
    record: Mapping[str, Any]


@dataclass(frozen=True)
class State:
    """Where a trial stands: one of the states of `ledger`, with a message when it failed."""

    event: str
    message: str = ""


class Monitor:
    """Hears what the runner does; the default says nothing."""

    def started(self, job: Job, resumed: bool) -> None: ...

    def progressed(self, job: Job, phase: str, done: int, total: int) -> None: ...

    def ended(self, job: Job, state: State, seconds: float) -> None: ...


def trial_command(directory: Path) -> list[str]:
    return [sys.executable, "-m", "experiments.running.trial_main", str(directory)]


def read_states(ids: Sequence[str], trials: Path, ledger: Ledger) -> dict[str, State]:
    """The state of each trial. A result on disk is the truth; the ledger may lag behind it."""
    recorded = ledger.states()
    states = {}
    for id in ids:
        record = recorded.get(id, {})
        if (trials / id / RESULT).exists():
            states[id] = State(FINISHED)
        elif not record or record["event"] == FINISHED:  # its directory was deleted: run it again
            states[id] = State(MISSING)
        else:
            states[id] = State(record["event"], record.get("message", ""))
    return states


def run_missing(
    jobs: Sequence[Job],
    trials: Path,
    ledger: Ledger,
    *,
    workers: int = 1,
    retry_failed: bool = False,
    command: Callable[[Path], list[str]] = trial_command,
    monitor: Monitor | None = None,
    poll_seconds: float = 0.1,
) -> dict[str, State]:
    """Brings every job to an end and returns their states.

    Failed and diverged trials of earlier runs are left alone unless `retry_failed`. On
    KeyboardInterrupt the running trials save their state before it is raised again. One runner
    at a time: see `Workspace.claimed`.
    """
    monitor = monitor or Monitor()
    ids = [job.id for job in jobs]
    before = read_states(ids, trials, ledger)
    again = {MISSING, INTERRUPTED, REFUSED} | ({FAILED, DIVERGED} if retry_failed else set())
    waiting = [job for job in jobs if before[job.id].event in again]
    running: dict[int, _Running] = {}
    recorded = {id for id, record in ledger.states().items() if record["event"] == FINISHED}
    for id, state in before.items():  # a runner was killed between a result and its line in the ledger
        if state.event == FINISHED and id not in recorded:
            ledger.append(id, FINISHED)
    try:
        while waiting or running:
            for slot in range(workers):
                if slot not in running and waiting:
                    job = waiting.pop(0)
                    if before[job.id].event in (FAILED, DIVERGED):
                        shutil.rmtree(trials / job.id, ignore_errors=True)
                    running[slot] = _start(job, trials, ledger, slot, workers, command)
                    monitor.started(job, before[job.id].event == INTERRUPTED)
            time.sleep(poll_seconds)
            for slot, child in list(running.items()):
                if child.process.poll() is None:
                    _pass_on_progress(child, monitor)
                    continue
                del running[slot]
                state, seconds = _outcome(child), time.monotonic() - child.began
                details = {"message": state.message} if state.message else {}
                ledger.append(child.job.id, state.event, seconds=round(seconds, 1), **details)
                monitor.ended(child.job, state, seconds)
                if state.event == REFUSED:  # as every other one would be
                    waiting.clear()
    finally:
        _stop([child.process for child in running.values()])
    return read_states(ids, trials, ledger)


@dataclass
class _Running:
    job: Job
    directory: Path
    process: subprocess.Popen
    began: float
    shown: str = ""


def _start(
    job: Job,
    trials: Path,
    ledger: Ledger,
    slot: int,
    workers: int,
    command: Callable[[Path], list[str]],
) -> _Running:
    directory = trials / job.id
    directory.mkdir(parents=True, exist_ok=True)
    (directory / FAILURE).unlink(missing_ok=True)
    write_file(directory / JOB, json.dumps(job.record, indent=1))
    ledger.append(job.id, STARTED, title=job.title)
    with open(directory / "output.txt", "a") as output:
        process = subprocess.Popen(
            command(directory),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=child_environment(slot, workers, trials.parent / "compiled"),
            start_new_session=True,  # Ctrl-C reaches the runner only, which asks them to save
        )
    return _Running(job, directory, process, time.monotonic())


def _pass_on_progress(child: _Running, monitor: Monitor) -> None:
    try:
        text = (child.directory / PROGRESS).read_text()
    except FileNotFoundError:
        return
    if text != child.shown:
        child.shown = text
        monitor.progressed(child.job, **json.loads(text))


def _outcome(child: _Running) -> State:
    """How an ended process left its trial."""
    code = child.process.returncode
    if (child.directory / RESULT).exists():
        return State(FINISHED)
    if (child.directory / FAILURE).exists():
        failure = json.loads((child.directory / FAILURE).read_text())
        return State(failure["state"], failure["message"])
    if code == STOPPED:
        return State(INTERRUPTED)
    log = child.directory / "output.txt"
    if code < 0:
        name = signal.Signals(-code).name
        hint = " (out of memory?)" if name == "SIGKILL" else ""
        return State(FAILED, f"its process was ended by {name}{hint}; output in {log}")
    return State(FAILED, f"its process ended with exit code {code} and no result; output in {log}")


def _stop(processes: Sequence[subprocess.Popen]) -> None:
    """Asks each process to save and end; kills it after the grace period."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + GRACE_SECONDS
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
