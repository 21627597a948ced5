"""A run's logs: JSON lines, TensorBoard and a progress line.

Files of a resumed run are truncated after the step that it resumes from.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar

from hma_jax.config import require
from hma_jax.runtime.files import IO_ERRNOS, write_file
from hma_jax.runtime.processes import is_writer
from hma_jax.training.checkpoints import SaveError

log = logging.getLogger(__name__)

Progress = Callable[[int, int, dict[str, float]], None]
"""Called as progress(step, steps, metrics) after every step. Once the run was validated, the metrics include the latest
validation numbers, as 'validation/loss' and so on."""


FLUSH_SECONDS = 30.0
"""The longest time until written lines are visible in the files."""


def open_log(run_dir: Path, start: int, steps: int, **how: Any) -> RunLog | SilentLog:
    """The log of this process: only one process of a program writes. Raises as `RunLog`."""
    return RunLog(run_dir, start, steps, **how) if is_writer() else SilentLog(steps, how["progress"])


class SilentLog:
    """The log of a process that is not the writer: keeps the losses, reports progress, writes nothing."""

    run_dir = None

    def __init__(self, steps: int, progress: Progress | None):
        self.steps, self.progress = steps, progress
        self.losses: list[float] = []

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self.losses.append(values["loss"])
        if self.progress is not None:
            self.progress(step, self.steps, dict(values))

    def nothing(self, *_: Any) -> None:
        """Replaces everything that only the writer does."""

    start_clock = discount = waited = write_start = write_validation = flush = close = nothing


class RunLog:
    """Writes the files of a run directory that `loop` lists. Drops lines of steps after the checkpoint."""

    def __init__(
        self,
        run_dir: Path,
        start: int,
        steps: int,
        *,
        every: int,
        flops_per_step: float,
        peak_flops: float | None,
        clock: Callable[[], float],
        progress: Progress | None,
        whole: bool = False,
    ):
        """A line of timing is written every `every` steps. With `whole`, raises ConfigError if the log lacks steps up
        to `start` (the checkpoint itself can be resumed without them)."""
        self.run_dir, self.steps, self.every = run_dir, steps, every
        self.flops_per_step, self.peak_flops = flops_per_step, peak_flops
        self.clock, self.progress = clock, progress
        kept = self._cut("metrics.jsonl", start)
        self.losses = [record["loss"] for record in kept]
        self.missing = start - len(kept)
        if self.missing:
            lacks = f"{run_dir / 'metrics.jsonl'} has only {len(kept)} of the {start} steps of the run's checkpoint"
            require(
                not whole,
                f"{lacks}, and a result is made from all of them: bring the file back, or remove {run_dir} to train again",
            )
            log.warning("%s; the run goes on from the checkpoint, without the others in its log", lacks)
        self._cut("timing.jsonl", start)
        self._cut("validation.jsonl", start)
        self.validation: dict[str, float] = {}
        self.mark, self.flushed = (clock(), start), clock()
        self.waiting = 0.0  # seconds since the mark
        self.files: dict[str, TextIO] = {}
        with self._writing("tensorboard"):
            self.tensorboard = TensorBoardWriter(run_dir / "tensorboard", start + 1)

    def _cut(self, name: str, step: int) -> list[dict[str, Any]]:
        """Drops lines after `step`, and incomplete lines. Returns the records kept."""
        path = self.run_dir / name
        if not path.exists():
            return []
        before = path.read_text(errors="replace")
        kept = _read_until(before, step)
        after = "".join(json.dumps(record) + "\n" for record in kept)
        if after != before:
            with self._writing(name):
                write_file(path, after)
        return kept

    def start_clock(self, step: int) -> None:
        """From now on, after `step` steps, time counts as training."""
        self.mark = (self.clock(), step)

    def discount(self, seconds: float) -> None:
        """Excludes `seconds` that have just passed from the timing."""
        self.mark = (self.mark[0] + seconds, self.mark[1])

    def waited(self, seconds: float) -> None:
        """Adds `seconds` in which a step waited for its batch."""
        self.waiting += seconds

    def write_start(self, record: Mapping[str, Any]) -> None:
        """Writes a line of execution.jsonl, which has one for every start of the run and is never cut."""
        self._append("execution.jsonl", {**record, **({"steps_missing_in_log": self.missing} if self.missing else {})})
        self.flush()

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self.losses.append(values["loss"])
        self._append("metrics.jsonl", {"step": step, **values})
        if step % self.every == 0 or step == self.steps:
            self._write_timing(step)
            self._write_tensorboard(step, values)
        if self.clock() - self.flushed > FLUSH_SECONDS:
            self.flush()
        if self.progress is not None:
            self.progress(step, self.steps, {**values, **self.validation})

    def write_validation(self, step: int, values: Mapping[str, float]) -> None:
        self._append("validation.jsonl", {"step": step, **values})
        self.validation = {f"validation/{name}": value for name, value in values.items()}
        self._write_tensorboard(step, self.validation)

    def _write_timing(self, step: int) -> None:
        now = self.clock()
        steps = step - self.mark[1]
        per_step = max(now - self.mark[0], 1e-9) / steps
        record = {"seconds_per_step": per_step, "seconds_waiting": self.waiting / steps}
        self.mark, self.waiting = (now, step), 0.0
        if self.flops_per_step:
            record["flops_per_second"] = self.flops_per_step / per_step
            if self.peak_flops:
                record["mfu"] = record["flops_per_second"] / self.peak_flops
        self._append("timing.jsonl", {"step": step, **record})
        self._write_tensorboard(step, {f"timing/{name}": value for name, value in record.items()})

    def _write_tensorboard(self, step: int, values: Mapping[str, float]) -> None:
        with self._writing("tensorboard"):
            self.tensorboard.write(step, values)

    def _append(self, name: str, record: Mapping[str, Any]) -> None:
        with self._writing(name):
            if name not in self.files:
                self.files[name] = open(self.run_dir / name, "a")
            self.files[name].write(json.dumps(record) + "\n")

    def flush(self) -> None:
        """Makes every written line durable: a checkpoint must not outlive its log."""
        self.flushed = self.clock()
        for name, file in self.files.items():
            with self._writing(name):
                file.flush()
                os.fsync(file.fileno())
        with self._writing("tensorboard"):
            self.tensorboard.flush()

    def close(self) -> None:
        """Closes the files. It does not fail: what matters was flushed before, and a full disk was reported then."""
        for file in (*self.files.values(), self.tensorboard):
            with suppress(OSError):
                file.close()

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise SaveError(
                f"{self.run_dir / name} could not be written: {error.strerror}. Make sure that there is space and "
                "permission to write, then run the same command again: it continues from the last checkpoint",
                passing=error.errno in IO_ERRNOS,
            ) from error


class TensorBoardWriter:
    """An event file in `directory`; events of earlier files from `first_step` on are hidden.

    The library's SummaryWriter passes events to a thread through a queue of ten. When the disk is full that thread
    dies, and the run would wait for ever. This class raises OSError instead.
    """

    def __init__(self, directory: Path, first_step: int):
        directory.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(directory / "events"))
        self._writer.write_event(Event(step=first_step, session_log=SessionLog(status=SessionLog.START)))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            event = Event(wall_time=time.time(), step=step, summary=scalar(name, value))
            self._writer.write_event(event)

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def _read_until(text: str, step: int) -> list[dict[str, Any]]:
    """The records up to `step` in JSON lines. Lines that are not JSON are dropped: a kill may leave an incomplete line,
    but only after everything that was flushed before the checkpoint."""
    kept: list[dict[str, Any]] = []
    for line in text.split("\n"):
        try:
            record = json.loads(line)
            if record["step"] <= step:
                kept.append(record)
        except (ValueError, TypeError, KeyError):
            continue
    return kept
