"""The lock under which one process makes an output, and a scratch directory to make it in.

The lock of `<dir>/<name>` is the file `<dir>/<name>.lock`, with a lease for machines that do not see our locks.
Its scratch directory is `<dir>/<name>.scratch.<random>`, on the same disk as the output.
"""

from __future__ import annotations

import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path

from hma_jax.runtime.locks import Held, Lock, exclusive, find_held

MIN_WAIT, MAX_WAIT = 0.1, 5.0
"""Seconds between two checks of whether another process has finished; each wait is 1.5 times the one before."""


class OutputLock:
    """The lock of an output, while it is held."""

    def __init__(self, output: Path, lock: Lock):
        self._output, self._lock = output, lock

    @cached_property
    def scratch(self) -> Path:
        """An empty directory. It is removed, if it still exists, when the lock is released."""
        directory = self._output.with_name(f"{self._output.name}.scratch.{secrets.token_hex(4)}")
        directory.mkdir()
        return directory

    def lost(self) -> bool:
        """Whether another process has taken the lock over, which then removed our scratch directory."""
        return self._lock.lost()


@contextmanager
def lock_output(output: Path, *, wait: float = 0.0, called: Path | None = None) -> Iterator[OutputLock]:
    """Holds the lock of `output`, whose parent directory is made if it is missing.

    Removes the scratch directories that dead holders left. While another process holds the lock, waits for up to `wait`
    seconds, then raises Held, which names that process and the output as it is `called` (default: `output`). After a
    wait `output` may exist: check again. Raises OSError.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        pauses, deadline = backoff(), time.monotonic() + wait
        while True:
            try:
                lock = stack.enter_context(exclusive(lock_file(output), lease=True, remove=True))
                break
            except Held as held:
                if time.monotonic() >= deadline:
                    raise Held(
                        f"another process is writing {called or output} ({held.who}); wait until it has finished, or "
                        "stop it",
                        held.holder,
                    ) from None
                time.sleep(next(pauses))
        for stale in output.parent.glob(f"{output.name}.scratch.*"):
            shutil.rmtree(stale, ignore_errors=True)
        held = OutputLock(output, lock)
        try:
            yield held
        finally:
            if "scratch" in vars(held):
                shutil.rmtree(held.scratch, ignore_errors=True)


def lock_file(output: Path) -> Path:
    return output.with_name(f"{output.name}.lock")


def find_held_lock(directory: Path) -> Held | None:
    """A lock in `directory` that a running process holds, as the error that says so; None if there is none."""
    return next(filter(None, map(find_held, sorted(directory.glob("*.lock")))), None)


def backoff() -> Iterator[float]:
    """Seconds to wait before each further check: endless exponential backoff."""
    pause = MIN_WAIT
    while True:
        yield pause
        pause = min(1.5 * pause, MAX_WAIT)
