"""Runs the trials that are missing, by a launcher, and recovers from failures.

A trial that crashes is recorded with its message and the others go on. One whose process is lost or asked to stop
is tried again and goes on from its checkpoint. The runner itself may be interrupted or killed at any point: the
next run goes on with what is there, and waits for trials that still run on other machines.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.running.attempts import (
    FAILURE,
    JOB,
    PROGRESS,
    RUN,
    STARTED,
    AttemptEnd,
    State,
    is_alive,
    outcome,
    read_progress,
    read_start,
    read_states,
)
from experiments.running.launchers.base import Launcher
from experiments.running.ledger import DIVERGED, FAILED, LOST, MISSING, PREEMPTED, REFUSED, RUNNING, Ledger
from experiments.running.shared_disk import patient
from hma_jax.config import ConfigError
from hma_jax.runtime.files import IO_ERRNOS, write_file

TRIES = 3
"""How often in one command a trial may be lost: it may run out of memory each time."""

POLL_SECONDS = 5.0
"""Seconds between two checks of trials that an earlier runner started elsewhere."""

RELAUNCH_SECONDS = 60.0
"""Seconds until trials that the launcher did not take, though it took others before, are launched again."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """A trial to run: `record` is what its process reads from job.json."""

    id: str
    title: str
    record: Mapping[str, Any]
    after: frozenset[str] = frozenset()  # ids of trials that have to end first, of those that run at all


class Monitor:
    """Callbacks for the progress of a runner; the default ignores it."""

    def launched(self, job: Job, resumed: bool) -> None: ...

    def progressed(self, job: Job, phase: str, done: int, total: int) -> None: ...

    def ended(self, job: Job, state: State, seconds: float, again: bool) -> None:
        """`again`: it will be tried once more."""


def run_missing(
    jobs: Sequence[Job],
    trials: Path,
    ledger: Ledger,
    launcher: Launcher,
    *,
    retry_failed: bool = False,
    monitor: Monitor | None = None,
) -> dict[str, State]:
    """Brings every job to an end and returns their states.

    Failed and diverged trials of earlier runs are left alone unless `retry_failed`; a failed one then goes on from
    its checkpoint, a diverged one starts anew. On KeyboardInterrupt the running trials save their state before it is
    raised again. One runner at a time: see `Workspace.locked`.
    """
    run = _Run(trials, ledger, launcher, monitor or Monitor())
    before = read_states([job.id for job in jobs], trials, ledger)
    recorded = ledger.states()
    for id, state in before.items():  # an earlier runner ended between an event and its line
        if state.event not in (RUNNING, MISSING) and recorded.get(id, {}).get("event") != state.event:
            run.record(id, state)
    again = {MISSING, LOST, PREEMPTED, REFUSED} | ({FAILED, DIVERGED} if retry_failed else set())
    run.waiting = [(job, before[job.id].event) for job in jobs if before[job.id].event in again]
    run.elsewhere = [job for job in jobs if before[job.id].event == RUNNING]
    try:
        run.run_all()
    finally:
        run.stop()
    return read_states([job.id for job in jobs], trials, ledger)


@dataclass
class _Attempt:
    job: Job
    directory: Path
    handle: Any
    launched: float
    start: dict[str, Any] | None = None
    shown: dict[str, Any] | None = None


class _Run:
    """`waiting` jobs with the state that each is in, those that are `running`, and those of earlier runners that
    still run `elsewhere`."""

    def __init__(self, trials: Path, ledger: Ledger, launcher: Launcher, monitor: Monitor):
        self.trials, self.ledger, self.launcher, self.monitor = trials, ledger, launcher, monitor
        self.waiting: list[tuple[Job, str]] = []
        self.elsewhere: list[Job] = []
        self.running: list[_Attempt] = []
        self.lost = Counter[str]()
        self.polled = -POLL_SECONDS
        self.launched = False  # whether the launcher has taken any trial
        self.relaunch_at = 0.0

    def run_all(self) -> None:
        while self.waiting or self.running or self.elsewhere:
            self._launch()
            time.sleep(self.launcher.pause)
            for attempt in list(self.running):
                self._poll(attempt)
            self._poll_elsewhere()

    def stop(self) -> None:
        """Trials that still run save their state; how each ended is recorded."""
        attempts, self.running = self.running, []
        if attempts:
            for attempt, ended in zip(attempts, self.launcher.stop([a.handle for a in attempts]), strict=True):
                self._end(attempt, outcome(attempt.directory, ended), again=False)

    def record(self, id: str, state: State, **details: Any) -> None:
        self.ledger.append(id, state.event, **details, **({"message": state.message} if state.message else {}))

    def _launch(self) -> None:
        room = max(self.launcher.at_once - len(self.running), 0)
        chosen = self._runnable()[:room]
        if not chosen or time.monotonic() < self.relaunch_at:
            return
        directories = [patient(self._prepare, job, state) for job, state in chosen]
        now = time.monotonic()
        try:
            handles = self.launcher.launch(directories)
        except (ConfigError, OSError) as error:
            passing = isinstance(error, ConfigError) or error.errno in IO_ERRNOS
            if not self.launched or not passing:  # its settings are wrong, or the disk is full
                raise
            log.warning("%s; trying again in %.0f s", error, RELAUNCH_SECONDS)  # trials that run already go on
            self.relaunch_at = now + RELAUNCH_SECONDS
            return
        self.launched = True
        self.waiting = [entry for entry in self.waiting if entry not in chosen]
        for (job, state), directory, handle in zip(chosen, directories, handles, strict=True):
            self.running.append(_Attempt(job, directory, handle, now))
            self.monitor.launched(job, resumed=state in (LOST, PREEMPTED))

    def _runnable(self) -> list[tuple[Job, str]]:
        """The jobs of `waiting` that wait for no other trial."""
        pending = (
            {job.id for job, _ in self.waiting} | {a.job.id for a in self.running} | {j.id for j in self.elsewhere}
        )
        return [(job, state) for job, state in self.waiting if not job.after & pending]

    def _prepare(self, job: Job, state: str) -> Path:
        """The directory of a trial that was left in `state`, ready for the next attempt."""
        directory = self.trials / job.id
        directory.mkdir(parents=True, exist_ok=True)
        if state == DIVERGED:  # from its checkpoint it would diverge again
            shutil.rmtree(directory / RUN, ignore_errors=True)
        for name in (FAILURE, STARTED, PROGRESS):
            (directory / name).unlink(missing_ok=True)
        write_file(directory / JOB, json.dumps(job.record, indent=1))
        return directory

    def _poll(self, attempt: _Attempt) -> None:
        ended = self.launcher.ended(attempt.handle)  # first: what is read below was written before
        self._note_start(attempt)
        if ended is not None:
            self.running.remove(attempt)
            state = outcome(attempt.directory, ended)
            self._end(attempt, state, again=self._try_again(attempt.job, state))
            if state.event == REFUSED:  # as every other one would be
                self.waiting.clear()
            return
        progress = read_progress(attempt.directory)
        if progress and progress != attempt.shown:
            attempt.shown = progress
            self.monitor.progressed(attempt.job, **progress)

    def _note_start(self, attempt: _Attempt) -> None:
        """An engine may start the process of an attempt more than once."""
        start = read_start(attempt.directory)
        if start and start != attempt.start:
            attempt.start = start
            where = {key: value for key, value in start.items() if key != "token"}
            self.ledger.append(attempt.job.id, RUNNING, title=attempt.job.title, **where)

    def _end(self, attempt: _Attempt, state: State, again: bool) -> None:
        self._note_start(attempt)
        seconds = time.monotonic() - attempt.launched
        if attempt.start or state.event != PREEMPTED:  # otherwise it was only queued
            self.record(attempt.job.id, state, seconds=round(seconds, 1))
        self.monitor.ended(attempt.job, state, seconds, again)

    def _try_again(self, job: Job, state: State) -> bool:
        self.lost[job.id] += state.event == LOST
        again = state.event == PREEMPTED or state.event == LOST and self.lost[job.id] < TRIES
        if again:
            self.waiting.insert(0, (job, state.event))
        return again

    def _poll_elsewhere(self) -> None:
        """What an earlier runner started and left: once its lock is free, it has ended or is ours to try."""
        if time.monotonic() - self.polled < POLL_SECONDS:
            return
        self.polled = time.monotonic()
        for job in list(self.elsewhere):
            try:
                if is_alive(self.trials / job.id):
                    continue
            except OSError as error:
                log.warning("the lock of %s cannot be read (%s); asking again", job.title, error.strerror)
                continue
            self.elsewhere.remove(job)
            state = outcome(self.trials / job.id, AttemptEnd(None, "its process is gone"))
            self.record(job.id, state)
            if state.event == LOST:
                self.waiting.append((job, LOST))
            else:
                self.monitor.ended(job, state, 0.0, again=False)
