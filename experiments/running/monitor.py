"""What a person sees of a sweep while it runs."""

from __future__ import annotations

from rich.markup import escape
from rich.progress import TaskID

from experiments.running.attempts import State
from experiments.running.ledger import FINISHED
from experiments.running.runner import Job, Monitor
from experiments.terminal.progress import duration, make_bars


class SweepMonitor(Monitor):
    """A bar for each running trial below one for all trials; a line for each trial that ends."""

    def __init__(self, total: int, done: int = 0):
        self.total, self.ended_count = total, done
        self.bars = make_bars()
        self.tasks: dict[str, TaskID] = {}
        self.all = self.bars.add_task("trials", total=total, completed=done, note="")

    def __enter__(self) -> SweepMonitor:
        self.bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.bars.stop()

    def launched(self, job: Job, resumed: bool) -> None:
        note = "resuming" if resumed else "starting"
        self.tasks[job.id] = self.bars.add_task(f"  {escape(job.title)}", total=None, note=note)

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
        more = "; it continues from its last checkpoint" if again else ""
        self.bars.console.print(
            f"[{colour}]{state.event}[/] {self.ended_count}/{self.total} {escape(job.title)} "
            f"[dim]({duration(seconds)})[/]{message}{more}"
        )
