"""One attempt at a trial: the files it leaves in the trial's directory, and the state of the trial that follows.

This is the same wherever the attempt runs. Its process holds the trial's lock, which has a lease
(`data_pipelines.publishing.output_lock`), for as long as it lives; any process that finds the lock free may try again.
A trial's directory holds, besides what `experiments.running.run_trial` lists,

    trial.lock      while an attempt is alive
    started.json    of the latest attempt: its process and host
    progress.json   how far it is
    failure.json    why it failed or diverged
    output.txt      what all attempts printed
"""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_pipelines.publishing.output_lock import OutputLock, find_held_lock, lock_output
from experiments.running.ledger import FAILED, FINISHED, LOST, MISSING, PREEMPTED, RUNNING, Ledger
from experiments.running.shared_disk import retry_io
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.files import write_file
from hma_jax.runtime.locks import EXPIRES, RENEWED_EVERY
from hma_jax.training.run_lock import CHECKPOINTS, list_steps

JOB, STARTED, PROGRESS = "job.json", "started.json", "progress.json"
RESULT, FAILURE, OUTPUT = "result.json", "failure.json", "output.txt"
RUN, EVALUATING = "run", "evaluating"
"""The training run, with its checkpoints."""

CRASHES = (signal.SIGABRT, signal.SIGBUS, signal.SIGSEGV)
"""Signals by which a process ends when a driver, an accelerator or memory fails."""

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that ask an attempt to stop. It saves and ends with 130 or 143; if it is not yet ready to save, it ends with
-n."""


@dataclass(frozen=True)
class State:
    """The state of a trial: one of the states of `ledger`, with a message if it has no result."""

    event: str
    message: str = ""


@dataclass(frozen=True)
class AttemptEnd:
    """How the process of an attempt ended. `code` is as in `subprocess`, negative for a signal; None if its end was not
    observed, in which case `why` says how it is known to have ended."""

    code: int | None
    why: str = ""


@contextmanager
def attempt(directory: Path) -> Iterator[OutputLock]:
    """The trial's lock, held while the process of an attempt runs. While another process holds it, waits until the
    lease of a dead machine would have expired. Raises Held if a living process holds it.
    """
    with lock_output(directory / "trial", wait=EXPIRES + RENEWED_EVERY) as lock:
        who = {"host": socket.gethostname(), "process": os.getpid(), "token": secrets.token_hex(4)}
        write_file(directory / STARTED, json.dumps(who | _engine_job()))
        yield lock


def _engine_job() -> dict[str, str]:
    """The engine's job that this process is part of, and its node, under the names that the engine's commands take."""
    array, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    job = f"{array}_{task}" if array else os.environ.get("SLURM_JOB_ID")
    named = {"job": job, "node": os.environ.get("SLURMD_NODENAME")}
    return {key: value for key, value in named.items() if value}


def newest_step(run: Path) -> int:
    """Step of the run's newest checkpoint; 0 if it has none."""
    return max(list_steps(run / CHECKPOINTS), default=0)


def reached(directory: Path) -> int:
    """How far a trial has got: its newest checkpoint's step, plus the batches of its evaluation that are measured. The
    next attempt does none of that again."""
    return newest_step(directory / RUN) + len(list((directory / EVALUATING).glob("*.npz")))


def is_alive(directory: Path) -> bool:
    """Whether a running process holds the trial's lock."""
    return find_held_lock(directory) is not None


def read_start(directory: Path) -> dict[str, Any] | None:
    """Host, process, engine job and token of the latest attempt; None before its process has started, or if the file
    cannot be read now."""
    return _read_now(directory / STARTED)


def read_progress(directory: Path) -> dict[str, Any] | None:
    """{phase, done, total}, or None before there is any, or if the file cannot be read now."""
    return _read_now(directory / PROGRESS)


def _read_now(path: Path) -> dict[str, Any] | None:
    try:
        return _read(path)
    except OSError:  # a shared disk that does not answer for a while; the next poll reads it again
        return None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, ValueError):  # the latter of a file that was cut off by a power loss or in copying
        return None


def outcome(directory: Path, ended: AttemptEnd) -> State:
    """The state in which an ended attempt left its trial; also LOST if what it left cannot be read now."""
    try:
        if (directory / RESULT).exists():
            return State(FINISHED)
        failure = _read(directory / FAILURE)
    except OSError as error:  # the next attempt finds the result, if there is one
        return State(LOST, f"the files in {directory} cannot be read now ({error.strerror})")
    if failure:
        return State(failure["state"], failure["message"])
    log = f"output in {directory / OUTPUT}"
    if ended.code is None:
        return State(LOST, f"{ended.why}; {log}")
    number = _signal(ended.code)
    if number in STOP_SIGNALS:
        return State(PREEMPTED, ended.why)
    if number == signal.SIGKILL:
        return State(LOST, f"its process was ended by SIGKILL (out of memory?); {log}")
    if ended.code == Exit.LOST:
        return State(LOST, f"its files could not be written (is the disk full?); {log}")
    if number in CRASHES:
        return State(LOST, f"its process was ended by {signal.Signals(number).name}; {log}")
    if number:
        return State(FAILED, f"its process was ended by {signal.Signals(number).name}; {log}")
    return State(FAILED, f"its process ended with exit code {ended.code} and no result; {log}")


def _signal(code: int) -> int:
    """The number of the signal that ended a process, as subprocess (-n) or a shell (128 + n) reports it; 0: none."""
    number = -code if code < 0 else code - 128
    return number if number in set(signal.Signals) else 0


def read_states(ids: Sequence[str], trials: Path, ledger: Ledger) -> dict[str, State]:
    """The state of each trial. A result on disk takes precedence; the ledger may lag behind it."""
    recorded = retry_io(ledger.states)
    return {id: retry_io(_state, trials / id, recorded.get(id)) for id in ids}


def _state(directory: Path, record: dict[str, Any] | None) -> State:
    if (directory / RESULT).exists():
        return State(FINISHED)
    if is_alive(directory):
        return State(RUNNING)
    if record is None or record["event"] == FINISHED or not directory.is_dir():  # it was deleted: run it again
        return State(MISSING)
    if record["event"] == RUNNING:  # its runner ended before it
        return outcome(directory, AttemptEnd(None, "its process is gone"))
    return State(record["event"], record.get("message", ""))
