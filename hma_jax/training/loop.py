"""The training loop: files, clocks and signals around a pure step. It does no maths.

It trains any model; only the step function differs. The loop dispatches step n + 1 before it reads the metrics of step
n, so the device never waits for the log.

Files of a run directory:
    metrics.jsonl     one line per step, deterministic fields only: a run that was killed and
                      resumed leaves the same bytes as one that was not
    validation.jsonl  held-out loss, also of each dataset, every so many steps; deterministic too
    timing.jsonl      seconds per step, of these waiting for a batch, FLOP/s, MFU: whatever depends on the machine
    execution.jsonl   one line per start of the run: from which step, how and on what it is computed
    tensorboard/      the same for TensorBoard
    profile/          what devices and host did in some steps, where that was asked for, see `step_trace`
    checkpoints/      see `checkpoints`; damaged/ holds those that were skipped
    diverged.json     of the last step that was not finite: its number, and the records of its batch
    .lock             held by the process that trains, see `run_lock`
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hma_jax.config import ConfigError, require
from hma_jax.runtime.cores import usable_cores
from hma_jax.runtime.exits import Exit, leave_stop_pending, take_pending_stop, take_signal
from hma_jax.runtime.locks import Lock
from hma_jax.runtime.processes import AgreedMaximum, barrier, is_writer
from hma_jax.training.checkpoints import Checkpoints, Description, SaveError
from hma_jax.training.divergence import Records, require_finite
from hma_jax.training.log import Progress, RunLog, SilentLog, open_log
from hma_jax.training.reading import agree_on_latest
from hma_jax.training.run_lock import CHECKPOINTS, locked_run
from hma_jax.training.state import FINITE
from hma_jax.training.step_trace import PROFILE, StepTrace


class Interrupted(RuntimeError):
    """The run was asked to stop (Ctrl-C, SIGTERM, SIGHUP) and has saved its state. `exit` is the exit code."""

    def __init__(self, message: str, exit: Exit = Exit.INTERRUPTED):
        super().__init__(message)
        self.exit = exit


@dataclass(frozen=True)
class LoopOptions:
    """How a run is observed and saved; nothing here changes its result.

    The state is saved at the end, when the run is interrupted, and at the intervals in steps and minutes below (0:
    never).
    """

    checkpoint_every: int = 0  # steps
    checkpoint_minutes: float = 10.0  # since the last save: the most that a kill loses
    keep_checkpoints: int = 2  # the newest ones
    keep_steps: tuple[int, ...] = ()  # also saved after these steps, and kept: other runs continue from there
    keep_every: int = 0  # steps: also saved at this interval, and kept
    skip_damaged: bool = False  # continue from the newest undamaged checkpoint
    log_every: int = 10  # steps between lines of timing.jsonl
    whole_log: bool = False  # refuse to continue if metrics.jsonl lacks steps: a result is made from all of them
    trace_steps: int = 0  # number of steps that are profiled after a start
    flops_per_step: float = 0.0  # by formula, for achieved FLOP/s; 0: unknown
    peak_flops: float | None = None  # of all devices together, for MFU
    # may_change(description of the checkpoint, its step) -> names of the fields that may differ when a run resumes.
    may_change: Callable[[Description, int], tuple[str, ...]] = lambda saved, step: ()
    clock: Callable[[], float] = time.perf_counter  # seconds

    def __post_init__(self):
        for name in ("keep_checkpoints", "log_every"):
            require(getattr(self, name) >= 1, f"LoopOptions.{name} must be at least 1, got {getattr(self, name)}")
        require(self.trace_steps >= 0, f"LoopOptions.trace_steps must not be negative, got {self.trace_steps}")


@dataclass(frozen=True)
class ValidationHook:
    """Metrics of the state, measured every `every` steps and after the last, written to validation.jsonl."""

    every: int
    measure: Callable[[Any], Mapping[str, float]]


@dataclass(frozen=True)
class RunInfo:
    """What identifies a run, and how it is computed."""

    description: Description  # its identity: compared with the checkpoint's
    execution: Mapping[str, Any] = field(default_factory=dict)  # how it is computed: recorded only
    # Converts a description that an earlier version wrote to the current form.
    modernise: Callable[[Description], Description] = lambda described: described
    # Called for the error message when the numbers of a step were not finite.
    records: Records = lambda index: ()


@dataclass(frozen=True)
class FitResult:
    state: Any = field(repr=False)
    losses: list[float]  # one per step in the log, from the run's first step (processes other than 0: of this start)
    seconds: float  # that this process spent in steps, without compiling, validating and writing a profile
    compile_seconds: float
    resumed_from: int


def fit(
    step_fn: Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]],
    shapes: Any,
    make_state: Callable[[], Any],
    make_batches: Callable[[int], Iterable[Any]],
    *,
    steps: int,
    run_dir: str | Path,
    info: RunInfo,
    put_batch: Callable[[Any], Any] = jax.device_put,
    options: LoopOptions = LoopOptions(),
    validation: ValidationHook | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Runs `step_fn` until `steps`, resuming from the latest checkpoint in `run_dir`.

    `step_fn(state, batch) -> (state, metrics)` is a jitted pure function that donates its
    state, a named tuple; `metrics` holds scalars, one of them 'loss', and checks (`state.FINITE`).
    `shapes` are the state's, with shardings; `make_state()` is called only when nothing is restored, so that there are
    never two states. `make_batches(start)` gives host batches from step `start` on. With several processes
    (`runtime.processes`) all call this; process 0 writes, and `losses` of the others begin with this start. When any of
    them is asked to stop, or when a save is due by the clock, all do so after the same step. Raises DivergedError,
    Interrupted, CheckpointError, SaveError and RunBusy; ConfigError for batches that end before the steps do, or that
    are passed instead of a function that makes them; and, once the state is saved, an OSError of `progress`, such as
    that of a pipe that nobody reads.
    """
    require(
        callable(make_batches),
        "make_batches must be a function: make_batches(start) gives the batches from step `start` on; got a "
        f"{type(make_batches).__name__}",
    )
    run_dir, clock = Path(run_dir), options.clock
    # One writer per run: of several processes only process 0 takes the lock and writes the log.
    with (
        locked_run(run_dir) if is_writer() else nullcontext() as lock,
        Checkpoints(
            run_dir / CHECKPOINTS,
            info.description,
            options.keep_checkpoints,
            info.modernise,
            options.keep_steps,
            options.keep_every,
        ) as checkpoints,
        _stop_requests() as stop,
    ):
        if agree_on_latest(checkpoints.directory) is None:
            start, state = 0, make_state()
        else:
            start, state = checkpoints.restore(shapes, options.may_change, options.skip_damaged)
        log = open_log(
            run_dir,
            start,
            steps,
            every=options.log_every,
            flops_per_step=options.flops_per_step,
            peak_flops=options.peak_flops,
            clock=clock,
            progress=progress,
            whole=options.whole_log,
        )
        traced = options.trace_steps if is_writer() else 0
        with closing(log), StepTrace(run_dir / PROFILE, traced, start, steps) as trace:
            if start >= steps:
                return FitResult(state, log.losses, 0.0, 0.0, start)
            log.write_start(_describe_start(start, info.execution))
            batches = iter(make_batches(start))
            batch = put_batch(_next(batches, start, steps))
            began = clock()
            compiled = step_fn.lower(state, batch).compile()
            compile_seconds = clock() - began
            between = _BetweenSteps(steps, run_dir, options, info.records, validation, log, checkpoints, lock, stop)
            barrier("compiled")

            between.start_clock(start)
            for step in range(start + 1, steps + 1):
                if step == trace.first:
                    jax.block_until_ready(state)
                    with between.aside():
                        trace.start()
                with jax.profiler.StepTraceAnnotation("train", step_num=step):
                    state, metrics = compiled(state, batch)
                    if step < steps:
                        asked = clock()
                        batch = _next(batches, step, steps)
                        log.waited(clock() - asked)
                        batch = put_batch(batch)
                if step == trace.last:
                    jax.block_until_ready(state)
                    with between.aside():
                        trace.stop()
                between.act(step, state, metrics)
            jax.block_until_ready(state)
            seconds = between.seconds()
            checkpoints.finish(steps, state)
            if between.unread:
                raise between.unread
    return FitResult(state, log.losses, seconds, compile_seconds, start)


class _BetweenSteps:
    """What is done between two steps: metrics are written, the state is validated and saved, the run is stopped."""

    def __init__(
        self,
        steps: int,
        run_dir: Path,
        options: LoopOptions,
        records: Records,
        validation: ValidationHook | None,
        log: RunLog | SilentLog,
        checkpoints: Checkpoints,
        lock: Lock | None,
        stop: _Stop,
    ):
        self._steps, self._run_dir, self._options = steps, run_dir, options
        self._records, self._validation = records, validation
        self._log, self._checkpoints, self._lock, self._stop = log, checkpoints, lock, stop
        self._agreement = AgreedMaximum()
        self._pending: tuple[int, dict[str, jax.Array]] | None = None  # a step whose metrics are not written yet
        self.unread: OSError | None = None  # the error if nobody reads the progress: a stop request
        self._began = self._saved = self._seconds_aside = 0.0  # see `start_clock`

    def start_clock(self, start: int) -> None:
        """Training begins now, after `start` steps."""
        self._began = self._saved = self._options.clock()
        self._log.start_clock(start)

    def seconds(self) -> float:
        """Seconds spent in training since `start_clock`."""
        return self._options.clock() - self._began - self._seconds_aside

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Time spent in the block is not counted as training."""
        before = self._options.clock()
        yield
        took = self._options.clock() - before
        self._log.discount(took)
        self._seconds_aside += took

    def act(self, step: int, state: Any, metrics: dict[str, jax.Array]) -> None:
        """Called after `step` was dispatched. Raises as `fit`."""
        self._report()
        self._pending = step, metrics
        self._checkpoints.raise_failure()
        wanted = self._agreement.result(self._request)
        last, stopping = step == self._steps, wanted == STOP
        to_validate = self._validation is not None and (last or step % self._validation.every == 0)
        to_save = last or wanted or _is_due(step, self._options)
        if to_validate or to_save:
            self._report()  # a diverged step is neither validated nor saved
        if to_validate:
            with self.aside():
                self._log.write_validation(step, self._validation.measure(state))
        if to_save:
            self._log.flush()
            _require_held(self._lock, self._run_dir, step)
            self._checkpoints.save(step, state)
            self._saved = self._options.clock()
        self._agreement.submit(self._request)
        if stopping and not last:
            self._checkpoints.finish(step, state)
            if self.unread and not self._stop.is_set():  # Ctrl-C also ends the reader of a pipe
                raise self.unread
            raise Interrupted(
                f"stopped at step {step} of {self._steps}; the same command resumes from {self._run_dir}",
                self._stop.exit,
            )

    def _report(self) -> None:
        """Writes the metrics of the pending step, if there is one. Raises DivergedError, and writes nothing, if they
        are not finite."""
        if self._pending is None:
            return
        step, metrics = self._pending
        # With the digits of single precision: this halves the size of the log, and nothing is lost.
        values = {name: float(str(np.float32(value))) for name, value in jax.device_get(metrics).items()}
        require_finite(step, values, self._log.run_dir, self._records)
        self._pending = None
        try:
            self._log.write(step, {name: value for name, value in values.items() if not name.startswith(FINITE)})
        except SaveError:
            raise
        except OSError as error:  # from the progress report, which is the last thing that the log does
            self.unread = error

    def _request(self) -> int:
        if self._stop.is_set() or self.unread:
            return STOP
        late = self._checkpoints.to_repeat or _is_late(self._options.clock() - self._saved, self._options)
        return SAVE if late else 0


def _next(batches: Iterator[Any], done: int, steps: int) -> Any:
    """The batch of the step after `done` steps."""
    try:
        return next(batches)
    except StopIteration:
        raise ConfigError(f"there are batches for only {done} of {steps} steps; give one for every step") from None


def _require_held(lock: Lock | None, run_dir: Path, step: int) -> None:
    """Raises SaveError unless `run_dir` is still the directory that this process locked."""
    if lock is not None and lock.lost():
        raise SaveError(
            f"{run_dir} was removed or replaced, so nothing was saved at step {step}. Restore it with its "
            "checkpoints, and run the same command again: it continues from the last one"
        )


STOP, SAVE = 2, 1
"""What a process may request between two steps; the largest request counts (`AgreedMaximum`)."""


def _is_due(step: int, options: LoopOptions) -> bool:
    """Whether `step` is one to save after."""
    every = [n for n in (options.checkpoint_every, options.keep_every) if n > 0]
    return step in options.keep_steps or any(step % n == 0 for n in every)


def _is_late(seconds: float, options: LoopOptions) -> bool:
    """Whether a save is due `seconds` after the last one."""
    return options.checkpoint_minutes > 0 and seconds >= 60 * options.checkpoint_minutes


def _describe_start(step: int, execution: Mapping[str, Any]) -> dict[str, Any]:
    """A line of execution.jsonl."""
    return {
        "resumed_from": step,
        "date": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "execution": dict(execution),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "cores": usable_cores(),
        "processes": jax.process_count(),
        "jax": jax.__version__,
    }


class _Stop(threading.Event):
    """Set when the run is asked to stop; `exit` says how."""

    exit = Exit.STOPPED  # if another process of the program was asked


@contextmanager
def _stop_requests() -> Iterator[_Stop]:
    """An event that SIGINT, SIGTERM or SIGHUP sets. A second SIGINT acts as usual, but further signals of the other
    kinds do not: schedulers send several, and wrappers forward each of them to a process that has already received it.
    A request that the block did not act on is left pending for the code after it."""
    event = _Stop()
    if threading.current_thread() is not threading.main_thread():
        yield event  # only the main thread may install handlers
        return
    previous = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    if previous[signal.SIGHUP] is signal.SIG_IGN:  # under nohup
        del previous[signal.SIGHUP]

    def on_signal(number: int, frame: object) -> None:
        del frame
        event.exit = take_signal(number)
        event.set()
        if number == signal.SIGINT:
            signal.signal(number, previous[number])

    for number in previous:
        signal.signal(number, on_signal)
    if (pending := take_pending_stop()) is not None:  # from a signal before this block whose exception was swallowed
        event.exit = pending
        event.set()
    try:
        yield event
        if event.is_set():  # set in the last step, after which there is nothing left to stop here
            leave_stop_pending(event.exit)
    finally:
        for number, handler in previous.items():
            if signal.getsignal(number) is not signal.SIG_IGN:  # SIGHUP is ignored after the first one
                signal.signal(number, handler)
