"""What a person sees while work goes on: bars on a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from hma_jax.runtime.exits import raise_pending_stop
from hma_jax.runtime.files import naming

OUTPUT = Path("standard output")
"""What an error names in place of a file."""


class _Output(Console):
    def print(self, *objects: Any, **how: Any) -> None:
        with naming(OUTPUT):
            super().print(*objects, **how)

    def on_broken_pipe(self) -> None:
        """Raises what rich has caught again, for the boundary of the program; rich itself would exit."""
        raise


console = _Output(highlight=False, emoji=False, width=None if sys.stdout and sys.stdout.isatty() else 110)
errors = Console(stderr=True, highlight=False, emoji=False)

FOLDED = 16
"""The least width of a table's column whose words may be broken."""

SAY_EVERY = 30.0
"""Seconds between lines about ongoing work if there is no terminal for a bar."""

Update = Callable[[int, int, str], None]
"""Called as update(done, total, note)."""


def say(message: str) -> None:
    """Prints a message as it is: without markup, and without line breaks besides the terminal's own."""
    console.print(message, markup=False, soft_wrap=True)


def short(path: Path) -> str:
    """A path as a user would write it here."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, FileNotFoundError):  # the latter in a directory that was removed
        return str(path)


def wrote(*paths: Path, then: str = "", about: str = "") -> None:
    """Prints what was written, the whole command that comes `then`, and a remark `about` it all."""
    for path in paths:
        console.print("wrote", Text(short(path), "bold"), soft_wrap=True)
    if then:
        say(f"next: {then}")
    if about:
        say(f"note: {about}")


def make_bars() -> Progress:
    """Bars of several tasks, each with a `note`; nothing without a terminal."""
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
    """Shows a bar while the block runs (in a log, a line now and then), and afterwards a line with the duration."""
    began = time.monotonic()
    if not console.is_terminal:
        console.print(f"{title} ...")
    with make_bars() as bars:
        task = bars.add_task(title, total=None, note="")
        last_line = began

        def update(done: int, total: int, note: str = "") -> None:
            nonlocal last_line
            raise_pending_stop()
            bars.update(task, completed=done, total=total, note=note)
            if not console.is_terminal and time.monotonic() - last_line >= SAY_EVERY:
                last_line = time.monotonic()
                console.print(f"{title}: {done}/{total} {escape(note)}", soft_wrap=True)

        yield update
    console.print(f"[green]done[/] {title} [dim]({duration(time.monotonic() - began)})")


class Eta:
    """Estimates the time left from the rate since the first call."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._first: tuple[float, int] | None = None

    def __call__(self, done: int, total: int) -> str:
        """', 3 min 20 s left', or '' while it is unknown.

        What was done before the first call, by an earlier process, does not count.
        """
        now = self._clock()
        if self._first is None:
            self._first = (now, done)
        began, before = self._first
        if done <= before or done >= total:
            return ""
        return f", {duration((now - began) / (done - before) * (total - done))} left"


class TidyTable(Table):
    """A plain table that cuts no cell short: columns that do not fit beside the others are put into further tables
    below, each of which repeats the first column."""

    def __init__(self, title: str | None = None):
        super().__init__(
            title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1)
        )

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        sizes = [_sizes(column, console, options) for column in self.columns]
        room = options.max_width - 1  # 2 for each column besides its words: padding, and a line or an edge
        parts = [[0]]
        for i in range(1, len(sizes)):
            if len(parts[-1]) > 1 and sum(sizes[k].minimum + 2 for k in (*parts[-1], i)) > room:
                parts.append([0])
            parts[-1].append(i)
        for chosen in parts:
            part = self._of(chosen, chosen is parts[0], chosen is parts[-1])
            inside = [sizes[k] for k in chosen]
            if sum(size.minimum + 2 for size in inside) > room:  # a very narrow terminal
                for column in part.columns:
                    column.no_wrap, column.overflow = False, "fold"
            elif sum(size.maximum + 2 for size in inside) > room:
                for column, width in zip(part.columns, _narrowed(inside, room - 2 * len(inside)), strict=True):
                    column.width = width
            yield from Table.__rich_console__(part, console, options)

    def _of(self, chosen: Sequence[int], first: bool, last: bool) -> Table:
        part, columns = TidyTable(self.title if first else None), [self.columns[i] for i in chosen]
        part.caption = self.caption if last else None
        for of in columns:
            part.add_column(
                of.header, justify=of.justify, overflow=of.overflow, no_wrap=of.no_wrap, min_width=of.min_width
            )
        for cells in zip(*(of.cells for of in columns), strict=True):
            part.add_row(*cells)
        return part


def _narrowed(sizes: Sequence[Measurement], room: int) -> list[int]:
    """Widths that add up to `room`: the widest columns become narrower first."""
    widths = [min(size.maximum, room) for size in sizes]
    while sum(widths) > room:
        wider = [i for i, size in enumerate(sizes) if widths[i] > size.minimum]
        widths[max(wider, key=widths.__getitem__)] -= 1
    return widths


def _sizes(column: Column, console: Console, options: ConsoleOptions) -> Measurement:
    """The width below which a column's words are broken or cut, and the width that it takes if it can."""
    whole = options.update(width=sys.maxsize)
    cells = [Measurement.get(console, whole, cell) for cell in (column.header, *column.cells)]
    most = max(column.min_width or 1, *(cell.maximum for cell in cells))
    if column.no_wrap:
        return Measurement(most, most)
    # A column that folds may break words.
    least = FOLDED if column.overflow == "fold" else max(cell.minimum for cell in cells)
    return Measurement(min(max(column.min_width or 1, least), most), most)


def tidy_table(title: str, *columns: str) -> TidyTable:
    """Words in the first column, numbers in the others."""
    table = TidyTable(title)
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if i else "left", no_wrap=True, min_width=len(name))
    return table


def duration(seconds: float) -> str:
    """2 h 5 min, 3 min 20 s or 4.2 s."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
