"""The ledger: an append-only record of what happened to every trial.

One JSON object per line, on disk before `append` returns. A process killed while it writes
leaves a torn last line, which the next writer cuts off. There must be one writer at a time:
see `Workspace.claimed`.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hma_jax.config import ConfigError

STARTED, FINISHED, FAILED, DIVERGED = "started", "finished", "failed", "diverged"
REFUSED = "refused"
"""Its sources are not those that the sweep was started with: it did not run, and may the next time."""
MISSING, INTERRUPTED = "missing", "interrupted"
"""States that no line states: no line at all, and started without an end."""


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
            try:
                records.append(json.loads(line))
            except ValueError as error:
                raise ConfigError(
                    f"{self.path}, line {number}: not JSON ({error}); delete that line to go on"
                ) from error
        return records

    def states(self) -> dict[str, dict[str, Any]]:
        """The last record of each trial, by id, with its `event` read as a state."""
        last = {record["trial"]: dict(record) for record in self.records()}
        for record in last.values():
            if record["event"] == STARTED:
                record["event"] = INTERRUPTED
        return last

    def append(self, trial: str, event: str, **details: Any) -> None:
        """Adds one line and waits until it is on disk."""
        line = json.dumps({"time": round(self.clock(), 3), "trial": trial, "event": event, **details})
        with open(self.path, "ab+") as file:
            _cut_torn_line(file)
            file.write(line.encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _cut_torn_line(file: Any) -> None:
    """Removes what follows the last newline."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 65536, 0))
    tail = file.read()
    if tail and not tail.endswith(b"\n"):
        file.truncate(size - (len(tail) - (tail.rfind(b"\n") + 1)))
    file.seek(0, os.SEEK_END)
