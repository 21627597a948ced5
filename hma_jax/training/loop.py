"""The training loop: files, clocks and signals around a pure step. It does no maths.

Any model trains here; what differs is the step function. The loop dispatches step n + 1
before it reads the metrics of step n, so the device never waits for the log.

Files of a run directory:
    metrics.jsonl   one line per step, deterministic fields only: a run that was killed and
                    resumed leaves the same bytes as one that was not
    timing.jsonl    seconds, throughput, utilisation: whatever depends on the machine
    tensorboard/    the same for TensorBoard
    checkpoints/    see `checkpoints`
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from tensorboardX import SummaryWriter

from hma_jax.config import ConfigError
from hma_jax.training.checkpoints import Checkpoints

Progress = Callable[[int, int, dict[str, float]], None]
"""Called as progress(step, steps, metrics) after every step."""


class DivergedError(RuntimeError):
    """The loss became infinite or NaN. The last good checkpoint is kept."""


class Interrupted(RuntimeError):
    """The run was asked to stop (Ctrl-C, SIGTERM) and saved its state first."""


@dataclass(frozen=True)
class LoopOptions:
    """How a run is observed and saved; nothing here changes its result."""

    checkpoint_every: int = 0  # steps; 0: only at the end and when interrupted
    log_every: int = 10  # steps between lines of timing.jsonl
    flops_per_step: float = 0.0  # by formula, for achieved FLOP/s; 0: unknown
    peak_flops: float | None = None  # of all devices together, for MFU
    may_change: tuple[str, ...] = ()  # fields of meta that a resumed run may change


@dataclass(frozen=True)
class FitResult:
    state: Any
    losses: list[float]  # one per step, from the first step of the run
    seconds: float  # spent in steps by this process, compilation excluded
    compile_seconds: float
    resumed_from: int


def fit(
    step_fn: Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]],
    state: Any,
    make_batches: Callable[[int], Iterator[Any]],
    *,
    steps: int,
    run_dir: Path,
    meta: dict[str, Any],
    put_batch: Callable[[Any], Any] = jax.device_put,
    options: LoopOptions = LoopOptions(),
    progress: Progress | None = None,
) -> FitResult:
    """Runs `step_fn` until `steps`, resuming from the latest checkpoint in `run_dir`.

    `step_fn(state, batch) -> (state, metrics)` is a jitted pure function that donates its
    state; `metrics` holds scalars, one of them 'loss'. `make_batches(start)` yields host
    batches from step `start` on. Raises DivergedError, Interrupted, CheckpointError.
    """
    run_dir = Path(run_dir)
    with Checkpoints(run_dir / "checkpoints", meta) as checkpoints, _stop_requests() as stop:
        start = 0
        if checkpoints.latest_step is not None:
            state = checkpoints.restore(state, options.may_change)
            start = checkpoints.latest_step
        log = _Log(run_dir, start, steps, options, progress)
        if start >= steps:
            return FitResult(state, log.losses, 0.0, 0.0, start)

        batches = make_batches(start)
        batch = put_batch(next(batches))
        began = time.perf_counter()
        compiled = step_fn.lower(state, batch).compile()
        compile_seconds = time.perf_counter() - began

        began = time.perf_counter()
        pending: tuple[int, dict[str, jax.Array]] | None = None
        for step in range(start + 1, steps + 1):
            state, metrics = compiled(state, batch)
            if step < steps:
                batch = put_batch(next(batches))
            if pending is not None:
                log.write(*pending)
            pending = (step, metrics)
            due = options.checkpoint_every and step % options.checkpoint_every == 0
            if due or step == steps or stop.is_set():
                log.write(*pending)  # a diverged step must not become a checkpoint
                pending = None
                log.flush()
                checkpoints.save(step, state)
                if stop.is_set() and step < steps:
                    checkpoints.wait()
                    log.close()
                    raise Interrupted(
                        f"stopped at step {step} of {steps}; the same command resumes from {run_dir}"
                    )
        jax.block_until_ready(state)
        seconds = time.perf_counter() - began
        checkpoints.wait()
        log.close()
    return FitResult(state, log.losses, seconds, compile_seconds, start)


class _Log:
    """Writes what a run reports; drops lines of steps that a killed run did not save."""

    def __init__(
        self, run_dir: Path, start: int, steps: int, options: LoopOptions, progress: Progress | None
    ):
        self.steps, self.options, self.progress = steps, options, progress
        kept = _keep_until(run_dir / "metrics.jsonl", start)
        self.losses = [record["loss"] for record in kept]
        if len(kept) != start:
            raise ConfigError(
                f"{run_dir / 'metrics.jsonl'} has {len(kept)} of the {start} steps of its "
                "checkpoint; the run directory was edited: use a new one"
            )
        _keep_until(run_dir / "timing.jsonl", start)
        self.metrics_file = open(run_dir / "metrics.jsonl", "a")
        self.timing_file = open(run_dir / "timing.jsonl", "a")
        self.board = SummaryWriter(str(run_dir / "tensorboard"), purge_step=start + 1)
        self.mark = (time.perf_counter(), start)

    def write(self, step: int, metrics: dict[str, jax.Array]) -> None:
        values = {name: float(value) for name, value in jax.device_get(metrics).items()}
        if not math.isfinite(values["loss"]):
            self.close()
            raise DivergedError(
                f"the loss is {values['loss']} at step {step}; lower the learning rate or "
                "lengthen the warm-up (the last checkpoint is kept)"
            )
        self.losses.append(values["loss"])
        self.metrics_file.write(json.dumps({"step": step, **values}) + "\n")
        if step % self.options.log_every == 0 or step == self.steps:
            self._write_timing(step)
            for name, value in values.items():
                self.board.add_scalar(name, value, step)
        if self.progress is not None:
            self.progress(step, self.steps, values)

    def _write_timing(self, step: int) -> None:
        now = time.perf_counter()
        per_step = (now - self.mark[0]) / (step - self.mark[1])
        self.mark = (now, step)
        record = {"step": step, "seconds_per_step": per_step}
        if self.options.flops_per_step:
            record["flops_per_second"] = self.options.flops_per_step / per_step
            if self.options.peak_flops:
                record["mfu"] = record["flops_per_second"] / self.options.peak_flops
        self.timing_file.write(json.dumps(record) + "\n")
        for name in record.keys() - {"step"}:
            self.board.add_scalar(f"timing/{name}", record[name], step)

    def flush(self) -> None:
        """Makes every written line durable: a checkpoint must not outlive its log."""
        for file in (self.metrics_file, self.timing_file):
            file.flush()
            os.fsync(file.fileno())

    def close(self) -> None:
        self.metrics_file.close()
        self.timing_file.close()
        self.board.close()


def _keep_until(path: Path, step: int) -> list[dict[str, Any]]:
    """Cuts a JSONL file after `step`; the last line may be torn. Returns the records kept."""
    if not path.exists():
        return []
    kept: list[dict[str, Any]] = []
    for line in path.read_text().splitlines():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            break  # torn by a kill; everything up to the checkpoint was flushed before it
        if record["step"] > step:
            break
        kept.append(record)
    aside = path.with_suffix(".tmp")
    aside.write_text("".join(json.dumps(record) + "\n" for record in kept))
    os.replace(aside, path)
    return kept


@contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """An event set by SIGINT or SIGTERM; a second signal acts as usual."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event  # only the main thread may install handlers
        return
    previous = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}

    def request(number: int, frame: object) -> None:
        del frame
        event.set()
        signal.signal(number, previous[number])

    for number in previous:
        signal.signal(number, request)
    try:
        yield event
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
