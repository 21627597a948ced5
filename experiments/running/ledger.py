"""The ledger: an append-only record of what happened to every trial.

One JSON object per line, on disk before `append` returns. A process killed while it writes
leaves a torn last line, which the next writer cuts off. There is one writer, the command that holds the study's
directory (`Workspace.locked`), wherever its trials run: a trial's process reports only in the trial's own directory
(`attempts`).
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.running.shared_disk import retry_io
from hma_jax.config import ConfigError, require
from hma_jax.runtime.files import append_line

RUNNING, FINISHED, DIVERGED, FAILED = "running", "finished", "diverged", "failed"
LOST, PREEMPTED = "lost", "preempted"
"""Ended without a result, through no fault of its own: its process is gone (killed, out of memory, a machine that
died), or it was asked to stop and has saved. Both continue from the last checkpoint."""

REFUSED = "refused"
"""Its sources or data are not those that the sweep was started with: it did not run, but may run the next time."""

MISSING = "missing"
"""The state of a trial without a line: it has not run."""


class Ledger:
    """The ledger at `path`; created with its first line. `clock` returns seconds since 1970."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.time):
        self.path = Path(path)
        self.clock = clock

    def records(self) -> list[dict[str, Any]]:
        """Every whole line, oldest first. Raises ConfigError for a damaged line before the last."""
        if not self.path.exists():
            return []
        lines = self.path.read_bytes().split(b"\n")
        records = []
        for number, line in enumerate(lines[:-1], start=1):  # what follows the last newline is torn
            where = f"{self.path}, line {number}"
            try:
                record = json.loads(line)
            except ValueError as error:
                raise ConfigError(f"{where}: not JSON ({error}); delete that line to continue") from error
            named = isinstance(record, dict) and all(isinstance(record.get(key), str) for key in ("trial", "event"))
            require(named, f"{where}: it has no trial with an event; delete that line to continue")
            records.append(record)
        return records

    def states(self) -> dict[str, dict[str, Any]]:
        """The last record of each trial, by id; its `event` is a state.

        The ledger cannot know whether a RUNNING trial still runs: see `attempts.read_states`.
        """
        return {record["trial"]: record for record in self.records()}

    def append(self, trial: str, event: str, **details: Any) -> None:
        """Adds one line and waits until it is on disk. A `message` names files as seen from the study's directory."""
        if "message" in details:
            details["message"] = name_within(self.path.parent, details["message"])
        line = json.dumps({"time": round(self.clock(), 3), "trial": trial, "event": event, **details})
        retry_io(append_line, self.path, line)


def name_within(root: Path, message: str) -> str:
    """`message` with the files under `root` named relative to it: ledgers and pages are read on other machines."""
    for place in (root.resolve(), root):
        if place != Path("."):
            message = re.sub(rf"(?<![\w./-]){re.escape(str(place))}/", "", message)
    return message
