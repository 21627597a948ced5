"""What a person sees while work goes on: bars on a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from experiments.running.attempts import State
from experiments.running.ledger import FINISHED
from experiments.running.runner import Job, Monitor
from hma_jax.runtime.exits import raise_lost_request

console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
errors = Console(stderr=True, highlight=False)

SAY_EVERY = 30.0
"""Seconds between lines about work that goes on, where there is no terminal for a bar."""

Update = Callable[[int, int, str], None]
"""Called as update(done, total, note)."""


def _bars() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=28),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[note]}"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextmanager
def step(title: str) -> Iterator[Update]:
    """A bar while the block runs, in a log a line now and then; one with the duration after it."""
    began = time.monotonic()
    if not console.is_terminal:
        console.print(f"{title} ...")
    with _bars() as bars:
        task = bars.add_task(title, total=None, note="")
        said = began

        def update(done: int, total: int, note: str = "") -> None:
            nonlocal said
            raise_lost_request()
            bars.update(task, completed=done, total=total, note=note)
            if not console.is_terminal and time.monotonic() - said >= SAY_EVERY:
                said = time.monotonic()
                console.print(f"{title}: {done}/{total} {escape(note)}", soft_wrap=True)

        yield update
    console.print(f"[green]done[/] {title} [dim]({_clock(time.monotonic() - began)})")


class Pace:
    """How long what is left will take, from how long it took since the first call."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._first: tuple[float, int] | None = None

    def __call__(self, done: int, total: int) -> str:
        """', 3 min 20 s left', or nothing as long as it cannot be told.

        What was done before the first call, by an earlier process, does not count.
        """
        now = self._clock()
        if self._first is None:
            self._first = (now, done)
        began, before = self._first
        if done <= before or done >= total:
            return ""
        return f", {_clock((now - began) / (done - before) * (total - done))} left"


def tidy_table(title: str, *columns: str) -> Table:
    """A plain table: words in the first column, numbers in the others."""
    table = Table(
        title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1)
    )
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if i else "left", no_wrap=True, min_width=len(name))
    return table


class SweepMonitor(Monitor):
    """A bar per running trial under one for all of them; a line for each that ends."""

    def __init__(self, total: int, done: int = 0):
        self.total, self.ended_count = total, done
        self.bars = _bars()
        self.tasks: dict[str, TaskID] = {}
        self.all = self.bars.add_task("trials", total=total, completed=done, note="")

    def __enter__(self) -> SweepMonitor:
        self.bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.bars.stop()

    def launched(self, job: Job, resumed: bool) -> None:
        note = "resuming" if resumed else "starting"
        self.tasks[job.id] = self.bars.add_task(f"  {job.title}", total=None, note=note)

    def progressed(self, job: Job, phase: str, done: int, total: int) -> None:
        self.bars.update(self.tasks[job.id], completed=done, total=total, note=phase)

    def ended(self, job: Job, state: State, seconds: float, again: bool) -> None:
        if job.id in self.tasks:  # otherwise an earlier command started it
            self.bars.remove_task(self.tasks.pop(job.id))
        if not again:
            self.ended_count += 1
            self.bars.update(self.all, completed=self.ended_count)
        colour = "green" if state.event == FINISHED else "yellow" if again else "red"
        message = f": {escape(state.message)}" if state.message else ""
        more = "; it goes on from its last checkpoint" if again else ""
        self.bars.console.print(
            f"[{colour}]{state.event}[/] {self.ended_count}/{self.total} {job.title} "
            f"[dim]({_clock(seconds)})[/]{message}{more}"
        )


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
