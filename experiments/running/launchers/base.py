"""The interface by which the runner starts and stops trials, wherever they run.

A launcher starts processes, says when they have ended and stops them. It knows nothing of what they do: they leave
results, failures and progress in their trials' directories (`experiments.running.attempts`), which must be shared by
every place.
"""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from experiments.running.attempts import AttemptEnd

GRACE_SECONDS = 60.0
"""How long a trial may take to save its state when it is asked to stop."""

Command = Callable[[Path], list[str]]
"""The command of the process that runs an attempt in a trial's directory."""


def trial_command(directory: Path) -> list[str]:
    return [sys.executable, "-m", "experiments.running.trial_main", str(directory)]


class Launcher(ABC):
    """Starts trials on this machine, a cluster, ... `Settings` is a dataclass of the settings that `--launcher-set`
    takes."""

    Settings: ClassVar[type]
    needs: ClassVar[str] = ""
    """The package that it works through; the extra with the launcher's name installs it."""
    pause: ClassVar[float] = 0.1
    """Seconds between two checks of what has ended."""

    at_once: int = sys.maxsize
    """How many trials it takes at a time; the engines queue what does not fit."""

    @classmethod
    def limit(cls, workers: int | None, settings: Any) -> int | None:
        """The value of `at_once` with this number of `workers`; None: as many as there is room for. Needs no engine."""
        return workers

    @classmethod
    @abstractmethod
    def share(cls, workers: int | None, settings: Any) -> float | None:
        """How many accelerators a trial gets with this number of `workers`; below 1: several trials share one. None:
        neither the settings nor the place determine it. Needs no engine."""

    @abstractmethod
    def launch(self, directories: Sequence[Path]) -> list[Any]:
        """Asks for an attempt at the trial of each directory, and returns a handle for each.

        Raises ConfigError if the place refuses them, and OSError; then none of them keeps running, and all may be asked
        for again.
        """

    @abstractmethod
    def ended(self, handle: Any) -> AttemptEnd | None:
        """How the attempt ended; None while it is queued or runs."""

    @abstractmethod
    def ask_to_stop(self, handles: Sequence[Any]) -> None:
        """Asks running attempts to save and end, and takes queued ones back. Does not wait."""

    @abstractmethod
    def kill(self, handles: Sequence[Any]) -> None:
        """Ends attempts at once; they may have ended already."""

    def stop(self, handles: Sequence[Any]) -> list[AttemptEnd]:
        """Asks, waits until all have ended, kills the rest after the grace period. Returns how each ended."""
        self.ask_to_stop(handles)
        deadline = time.monotonic() + GRACE_SECONDS
        while time.monotonic() < deadline and any(self.ended(h) is None for h in handles):
            time.sleep(self.pause)
        late = [h for h in handles if self.ended(h) is None]
        self.kill(late)
        killed = AttemptEnd(None, f"it had not saved {GRACE_SECONDS:g} s after it was asked to stop, and was killed")
        return [ended if (ended := self.ended(h)) and h not in late else killed for h in handles]

    def place(self, handle: Any, start: Mapping[str, Any] | None) -> str | None:
        """Where an attempt ran, as its process said at its `start`; None if that is not known."""
        return start and start["host"]

    def leave_out(self, handle: Any, place: str) -> bool:
        """Starts nothing more at the `place` where an attempt ran. False if it cannot, or if there is no other."""
        return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        """Leaves the place. Everything launched has ended."""
        return
