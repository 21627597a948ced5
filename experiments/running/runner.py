"""Runs the trials that are missing, by a launcher, and recovers from failures.

A trial that crashes is recorded with its message and the others go on. A trial whose process is lost or asked to stop
is tried again from its checkpoint, for as long as its attempts get further (`attempts.reached`). A place where one
trial after another is lost before its first step gets no more trials. The runner itself may be interrupted or killed at
any point: the next run continues with what is there, and waits for trials that still run on other machines.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.running.attempts import (
    FAILURE,
    JOB,
    OUTPUT,
    PROGRESS,
    STARTED,
    AttemptEnd,
    State,
    is_alive,
    outcome,
    reached,
    read_progress,
    read_start,
    read_states,
)
from experiments.running.launchers.base import Launcher
from experiments.running.ledger import FAILED, FINISHED, LOST, MISSING, PREEMPTED, REFUSED, RUNNING, Ledger
from experiments.running.shared_disk import retry_io
from hma_jax.config import ConfigError
from hma_jax.runtime.files import IO_ERRNOS, write_file
from hma_jax.runtime.locks import EXPIRES, RENEWED_EVERY

TRIES = 3
"""How many attempts at a trial, in a row and in one command, may be lost or stopped without getting further: it may run
out of memory each time, or need more time than its jobs have."""

BAD_PLACE = 3
"""If this many trials in a row are lost before their first step, the place where they ran is to blame."""

STALL_SECONDS = 1800.0
"""Seconds without progress after which a running trial is said to stall."""

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
    after: frozenset[str] = frozenset()  # ids of trials that have to end first, if they run at all


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
    lost: Callable[[], bool] = lambda: False,
    retry_failed: bool = False,
    monitor: Monitor | None = None,
) -> dict[str, State]:
    """Runs every job to its end and returns their states.

    Trials of earlier runs that diverged are left alone: they would diverge again. So are failed ones unless
    `retry_failed`; they then continue from their checkpoints. On KeyboardInterrupt the running trials save their state
    before it is raised again. One runner at a time (`Workspace.locked`): raises ConfigError, and leaves the trials
    alone, if `lost` says that another one has taken over.
    """
    run = _Run(trials, ledger, launcher, monitor or Monitor(), lost)
    before = read_states([job.id for job in jobs], trials, ledger)
    recorded = ledger.states()
    for id, state in before.items():  # an earlier runner ended between an event and its line
        if state.event not in (RUNNING, MISSING) and recorded.get(id, {}).get("event") != state.event:
            run.record(id, state)
    again = {MISSING, LOST, PREEMPTED, REFUSED} | ({FAILED} if retry_failed else set())
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
    reached: int  # how far the trial was when this attempt began
    began: float  # when its process was first seen; before that, when it was launched
    moved: float  # when it last made progress
    start: dict[str, Any] | None = None
    shown: dict[str, Any] | None = None


class _Run:
    """`waiting` jobs with their states, jobs that are `running`, and those of earlier runners that still run
    `elsewhere`."""

    def __init__(self, trials: Path, ledger: Ledger, launcher: Launcher, monitor: Monitor, lost: Callable[[], bool]):
        self.trials, self.ledger, self.launcher, self.monitor, self.lost = trials, ledger, launcher, monitor, lost
        self.waiting: list[tuple[Job, str]] = []
        self.elsewhere: list[Job] = []
        self.running: list[_Attempt] = []
        self.fruitless = Counter[str]()  # attempts in a row at a trial that did not get further
        self.lost_at: dict[str, set[str]] = {}  # trials lost before their first step, in a row, by place
        self.polled, self.asked = -POLL_SECONDS, 0.0
        self.launched = False  # whether the launcher has taken any trial
        self.relaunch_at = 0.0

    def run_all(self) -> None:
        while self.waiting or self.running or self.elsewhere:
            self._require_ours()
            self._launch()
            time.sleep(self.launcher.pause)
            for attempt in list(self.running):
                self._poll(attempt)
            self._poll_elsewhere()

    def _require_ours(self) -> None:
        if time.monotonic() - self.asked < RENEWED_EVERY:
            return
        self.asked = time.monotonic()
        if self.lost():
            self.running.clear()
            raise ConfigError(
                f"another command has taken over {self.trials.parent}, because this one did not renew its lock for "
                f"{EXPIRES / 60:.0f} minutes; that one continues the study"
            )

    def stop(self) -> None:
        """Lets trials that still run save their state, and records how each ended."""
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
        directories = [retry_io(self._prepare, job) for job, _ in chosen]
        before = [retry_io(reached, directory) for directory in directories]
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
        for (job, state), directory, handle, got in zip(chosen, directories, handles, before, strict=True):
            self.running.append(_Attempt(job, directory, handle, now, got, began=now, moved=now))
            self.monitor.launched(job, resumed=state in (LOST, PREEMPTED))

    def _runnable(self) -> list[tuple[Job, str]]:
        """The jobs of `waiting` that wait for no other trial."""
        pending = (
            {job.id for job, _ in self.waiting} | {a.job.id for a in self.running} | {j.id for j in self.elsewhere}
        )
        return [(job, state) for job, state in self.waiting if not job.after & pending]

    def _prepare(self, job: Job) -> Path:
        """The directory of a trial, ready for the next attempt."""
        directory = self.trials / job.id
        directory.mkdir(parents=True, exist_ok=True)
        for name in (FAILURE, STARTED, PROGRESS):
            (directory / name).unlink(missing_ok=True)
        write_file(directory / JOB, json.dumps(job.record, indent=1))
        return directory

    def _poll(self, attempt: _Attempt) -> None:
        ended = self.launcher.ended(attempt.handle)  # read first: what is read below was written earlier
        self._note_start(attempt)
        if ended is not None:
            self.running.remove(attempt)
            state = outcome(attempt.directory, ended)
            self._judge_place(attempt, state)
            again = self._try_again(attempt, state)
            if state.event == PREEMPTED and not again:
                why = f"stopped {TRIES} times in a row before it got further; its attempts need more time"
                state = State(PREEMPTED, ": ".join(filter(None, (why, state.message))))
            self._end(attempt, state, again)
            if state.event == REFUSED:  # as every other trial would be
                self.waiting.clear()
            return
        if self._note_progress(attempt):
            self.monitor.progressed(attempt.job, **attempt.shown)
        elif attempt.start and time.monotonic() - attempt.moved > STALL_SECONDS:
            attempt.moved = math.inf  # reported once
            where = f"process {attempt.start['process']} on {attempt.start['host']}"
            log.warning(
                "%s makes no progress since %.0f minutes; if it hangs (%s), kill its %s, and it continues from its "
                "checkpoint", attempt.job.title, STALL_SECONDS / 60, attempt.directory / OUTPUT, where,
            )  # fmt: skip

    def _note_progress(self, attempt: _Attempt) -> bool:
        progress = read_progress(attempt.directory)
        if not progress or progress == attempt.shown:
            return False
        attempt.shown, attempt.moved = progress, time.monotonic()
        return True

    def _note_start(self, attempt: _Attempt) -> None:
        """An engine may start the process of an attempt more than once."""
        start = read_start(attempt.directory)
        if start and start != attempt.start:
            if attempt.start:
                self._count(attempt)
                if self.fruitless[attempt.job.id] >= TRIES:  # the engine would repeat it forever
                    self.launcher.ask_to_stop([attempt.handle])
            attempt.start, attempt.began = start, time.monotonic()
            attempt.moved = attempt.began
            where = {key: value for key, value in start.items() if key != "token"}
            self.ledger.append(attempt.job.id, RUNNING, title=attempt.job.title, **where)

    def _end(self, attempt: _Attempt, state: State, again: bool) -> None:
        self._note_start(attempt)
        seconds = time.monotonic() - attempt.launched
        if attempt.start or state.event != PREEMPTED:  # otherwise it was only queued
            self.record(attempt.job.id, state, seconds=round(seconds, 1))
        self.monitor.ended(attempt.job, state, seconds, again)

    def _count(self, attempt: _Attempt) -> None:
        """Counts an attempt that has ended, depending on what it achieved."""
        before, attempt.reached = attempt.reached, retry_io(reached, attempt.directory)
        self.fruitless[attempt.job.id] = 0 if attempt.reached > before else self.fruitless[attempt.job.id] + 1

    def _try_again(self, attempt: _Attempt, state: State) -> bool:
        if state.event not in (LOST, PREEMPTED):
            return False
        job = attempt.job
        if state.event == LOST or attempt.start:  # otherwise it was only queued
            self._count(attempt)
        if self.fruitless[job.id] >= TRIES:
            return False
        if self._is_held(job):  # by an earlier runner's attempt, or until the lease of a dead machine is over
            self.elsewhere.append(job)
        else:  # a trial that got no further goes last: others may meanwhile show that the place is to blame
            self.waiting.insert(len(self.waiting) if self.fruitless[job.id] else 0, (job, state.event))
        return True

    def _is_held(self, job: Job) -> bool:
        try:
            return is_alive(self.trials / job.id)
        except OSError:  # the next attempt finds out
            return False

    def _judge_place(self, attempt: _Attempt, state: State) -> None:
        """A broken GPU or node would lose one trial after another, within seconds."""
        self._note_progress(attempt)
        place = self.launcher.place(attempt.handle, attempt.start)
        if state.event == FINISHED or attempt.shown and attempt.shown["done"]:
            self.lost_at.pop(place, None)
        elif place and state.event == LOST:
            lost = self.lost_at.setdefault(place, set())
            lost.add(attempt.job.id)
            to_blame = len(lost) >= BAD_PLACE and self._others_run(attempt)
            left_out = to_blame and self.launcher.leave_out(attempt.handle, place)
            if left_out or len(lost) == BAD_PLACE:
                log.warning(
                    "%d trials in a row were lost on %s before their first step%s; the last one: %s",
                    len(lost), place, ", which gets no more of them" if left_out else "", state.message,
                )  # fmt: skip

    def _others_run(self, attempt: _Attempt) -> bool:
        """Whether a trial that began before this attempt still runs, in a place where none was lost. If not, something
        that all places share may be to blame, such as a disk or the installation of JAX."""
        older = (other for other in self.running if other.began <= attempt.began)
        places = {self.launcher.place(other.handle, other.start) for other in older}
        return bool(places - {None} - self.lost_at.keys())

    def _poll_elsewhere(self) -> None:
        """Checks trials that an earlier runner started and left: once its lock is free, a trial has ended or may be
        tried by this runner."""
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
