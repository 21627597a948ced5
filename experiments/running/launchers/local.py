"""This machine: processes that share its cores and accelerators and end with the command that started them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.running.attempts import OUTPUT, AttemptEnd
from experiments.running.children import child_environment
from experiments.running.launchers.base import Command, Launcher, trial_command
from experiments.running.slots import core_place, cut, find_accelerators


@dataclass(frozen=True)
class LocalSettings:
    """No settings: the machine's cores and accelerators are divided by --workers."""


@dataclass(frozen=True)
class Child:
    """A process that this launcher started."""

    process: subprocess.Popen
    slot: int


class LocalLauncher(Launcher):
    """`workers` trials at a time, each in a slot of its own. Raises ConfigError for more workers than the machine can
    hold."""

    Settings = LocalSettings

    def __init__(
        self,
        root: Path,
        workers: int | None,
        settings: LocalSettings = LocalSettings(),
        command: Command = trial_command,
    ):
        self.at_once = self.limit(workers, settings)
        cores = sorted(os.sched_getaffinity(0), key=core_place) if hasattr(os, "sched_getaffinity") else ()
        self._accelerators = find_accelerators()
        self._slots = cut(self.at_once, self._accelerators, cores)
        self._free = list(range(self.at_once))
        self._root, self._command = root, command

    @classmethod
    def limit(cls, workers: int | None, settings: LocalSettings) -> int:
        return workers or 1

    @classmethod
    def share(cls, workers: int | None, settings: LocalSettings) -> float | None:
        """The share of this machine's accelerators that each trial gets; None if there are none."""
        accelerators = find_accelerators()
        if accelerators is None or not workers or workers == 1:
            return accelerators and float(len(accelerators.names))
        slots = cut(workers, accelerators, ())
        return sum(len(slot.accelerators.names) / slot.sharers for slot in slots) / workers

    def launch(self, directories: Sequence[Path]) -> list[Child]:
        children: list[Child] = []
        try:
            for directory in directories:
                children.append(self._start(directory))
        finally:
            if len(children) < len(directories):  # the caller has no handles of the ones that did start
                self.stop(children)
        return children

    def _start(self, directory: Path) -> Child:
        slot = self._free[0]
        kind = self._accelerators.kind if self._accelerators else ""
        with open(directory / OUTPUT, "a") as output:
            process = subprocess.Popen(
                self._command(directory),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=child_environment(self._root / "compiled", self._slots[slot], kind),
                start_new_session=True,  # Ctrl-C reaches the runner only, which asks them to save
            )
        self._free.remove(slot)
        return Child(process, slot)

    def ended(self, handle: Child) -> AttemptEnd | None:
        code = handle.process.poll()
        if code is None:
            return None
        if handle.slot not in self._free:
            self._free.append(handle.slot)
        return AttemptEnd(code)

    def place(self, handle: Child, start: Mapping[str, Any] | None) -> str:
        has = self._slots[handle.slot].accelerators
        return f"slot {handle.slot}" + (f" ({has.kind} {', '.join(has.names)})" if has else "")

    def leave_out(self, handle: Child, place: str) -> bool:
        if self.at_once == 1:
            return False
        self._free.remove(handle.slot)
        self.at_once -= 1
        return True

    def ask_to_stop(self, handles: Sequence[Child]) -> None:
        for handle in handles:
            handle.process.terminate()

    def kill(self, handles: Sequence[Child]) -> None:
        for handle in handles:
            handle.process.kill()
            handle.process.wait()
