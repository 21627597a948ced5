"""The process of one trial: `python -m experiments.running.trial_main DIRECTORY`.

Reads DIRECTORY/job.json, runs the trial, and on failure leaves DIRECTORY/failure.json with
the state and one message. A trial whose sources or data are not those that job.json names is refused before any work.
A launcher starts this, on whichever machine; run it by hand to debug a trial.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from experiments.running.attempts import FAILURE, JOB, PROGRESS, RESULT, RUN, attempt
from experiments.running.children import NoAccelerator, enter_child, require_accelerator
from experiments.running.ledger import DIVERGED, FAILED, LOST, REFUSED
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit, exit_of_interrupt, raise_pending_stop, sigterm_as_interrupt
from hma_jax.runtime.files import write_file
from hma_jax.runtime.locks import Held
from hma_jax.runtime.user_code import raising_as_called

POLL_SECONDS = 30.0
"""Seconds between two checks that the trial is still ours."""

DEVICE_FAILURES = ("FAILED_PRECONDITION", "INTERNAL", "UNAVAILABLE")
"""How JAX's messages begin if a device or its driver fails; a device with too little memory does not count as
failing."""


def main(directory: Path) -> int:
    """Runs the trial and returns the exit code. FAILED: see failure.json, also if it diverged; REFUSED: the sources
    or the data changed; LOST: its files could not be written, its data could not be read, or its accelerator failed;
    STOPPED or INTERRUPTED: the next attempt continues from here, or another one is running."""
    enter_child()  # before anything imports JAX
    try:
        before = _read_failure(directory)
        with sigterm_as_interrupt(), attempt(directory) as lock:
            # Another attempt may have ended while this one waited.
            if (directory / RESULT).exists():
                return Exit.DONE
            if _read_failure(directory) not in ("", before):
                return Exit.FAILED
            return _run(directory, lock.lost)
    except KeyboardInterrupt as request:
        return exit_of_interrupt(request)
    except Held as held:
        print(f"another attempt at this trial is running: {held}", file=sys.stderr)
        return Exit.STOPPED
    except OSError:  # before there was anything in which to record it
        _print_traceback()
        return Exit.LOST


def _read_failure(directory: Path) -> str:
    try:
        return (directory / FAILURE).read_text()
    except FileNotFoundError:
        return ""


def _run(directory: Path, lost: Callable[[], bool]) -> int:
    job = json.loads((directory / JOB).read_text())
    closure = _load_sources(directory, job.get("code"))
    if closure is None:
        return Exit.REFUSED

    from data_pipelines.errors import DataError, UnreachableError
    from experiments.running.initial_model import initial_from_trial
    from experiments.running.job import read_job
    from experiments.running.provenance import InputsChanged, Provenance, record_start
    from experiments.running.run_trial import run_trial
    from experiments.running.shared_runs import begin_shared
    from experiments.running.trial import trial_id
    from experiments.running.workspace import Workspace
    from hma_jax.config.json import from_dict
    from hma_jax.training.divergence import DivergedError
    from hma_jax.training.loop import Interrupted

    report = _ProgressFile(directory / PROGRESS, lost)
    try:
        with raising_as_called():
            require_accelerator()
            (trial, execution, shared), inputs = read_job(job), from_dict(Provenance, job["provenance"])
            record_start(directory, inputs, closure)
            if branched_from := begin_shared(directory, shared.before):
                print(f"goes on from step {branched_from[1]} of trial {branched_from[0]}", flush=True)
            begin = None
            if trial.source:
                source = directory.parent / trial_id(trial.source, inputs) / RUN
                begin = partial(initial_from_trial, trial, source)
            workspace = Workspace(directory.parent.parent)
            run_trial(
                trial, inputs, workspace, directory, execution=execution, keep=shared.keep, begin=begin, progress=report
            )
        return Exit.DONE
    except Interrupted as request:
        return request.exit
    except TakenOver as error:
        print(error, file=sys.stderr)
        return Exit.STOPPED
    except InputsChanged as error:
        write_file(directory / FAILURE, json.dumps({"state": REFUSED, "message": str(error)}))
        return Exit.REFUSED
    except Exception as error:  # the boundary of the process: every failure becomes a record
        _print_traceback()
        known = isinstance(error, (ConfigError, DataError, DivergedError))
        message = str(error) if known else f"{type(error).__name__}: {error}"
        # A disk that is full or gone, or a device that fails, is not the trial's fault.
        lost = isinstance(error, (OSError, UnreachableError, NoAccelerator)) or _is_of_device(error)
        state = LOST if lost else DIVERGED if isinstance(error, DivergedError) else FAILED
        with suppress(OSError):  # most likely on the same disk: then only the exit code says it
            write_file(directory / FAILURE, json.dumps({"state": state, "message": message}))
        return Exit.LOST if lost else Exit.FAILED


def _is_of_device(error: Exception) -> bool:
    from jax.errors import JaxRuntimeError

    return isinstance(error, JaxRuntimeError) and str(error).startswith(DEVICE_FAILURES)


def _print_traceback() -> None:
    with suppress(OSError):  # output.txt lies on the disk that may be full
        traceback.print_exc()


class TakenOver(Exception):
    """Another attempt works on the trial: this process was cut off for longer than its lease."""


def _load_sources(directory: Path, given: dict[str, str] | None) -> dict[str, str] | None:
    """Imports the closure of what is run and returns it; None, after writing failure.json, if it is not the given
    one."""
    from experiments.running.provenance import CodeChanged, load_sources

    try:
        return load_sources(given)
    except CodeChanged as error:
        write_file(directory / FAILURE, json.dumps({"state": REFUSED, "message": str(error)}))
        return None


class _ProgressFile:
    """Writes {phase, done, total} for the runner to show, a few times a second at most.

    Raises TakenOver if `lost` says that another attempt has taken over the trial.
    """

    def __init__(self, path: Path, lost: Callable[[], bool]):
        self.path, self.lost = path, lost
        self.last = ("", 0.0)
        self.polled = time.monotonic()

    def __call__(self, phase: str, done: int, total: int) -> None:
        raise_pending_stop()
        now = time.monotonic()
        if now - self.polled >= POLL_SECONDS:
            self.polled = now
            if self.lost():
                raise TakenOver(f"{self.path.parent}: another attempt at this trial has taken over")
        if phase == self.last[0] and now - self.last[1] < 0.3 and done < total:
            return
        self.last = (phase, now)
        aside = self.path.with_suffix(".tmp")
        with suppress(OSError):  # progress is only displayed; writes that must not be lost raise where they are made
            aside.write_text(json.dumps({"phase": phase, "done": done, "total": total}))
            aside.replace(self.path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path, metavar="DIRECTORY")
    sys.exit(main(parser.parse_args().directory.absolute()))
