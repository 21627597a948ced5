"""The right to make one thing, and a directory to make it in.

A claim of `<dir>/<name>` is the lock file `<dir>/<name>.lock`, with a lease for machines that see no lock of ours.
Its scratch directory is `<dir>/<name>.scratch.<random>`, on the same disk as what is made.
"""

from __future__ import annotations

import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path

from hma_jax.runtime.locks import Held, Lock, exclusive

MIN_WAIT, MAX_WAIT = 0.1, 5.0
"""Seconds between two checks whether another process has finished; each wait is 1.5 times the one before."""


class Claim:
    """A claim that is held."""

    def __init__(self, place: Path, lock: Lock):
        self._place, self._lock = place, lock

    @cached_property
    def scratch(self) -> Path:
        """An empty directory, removed when the claim ends, if it is still there."""
        directory = self._place.with_name(f"{self._place.name}.scratch.{secrets.token_hex(4)}")
        directory.mkdir()
        return directory

    def lost(self) -> bool:
        """Whether another process has taken it over: its scratch directory is gone then."""
        return self._lock.lost()


@contextmanager
def claim(place: Path, *, wait: bool = False) -> Iterator[Claim]:
    """Holds the right to make `place`, whose parent is made if it is missing.

    What dead holders left in scratch directories is removed. While another process holds it: raises Held, naming
    it, or with `wait` waits until it ends. What is to be made may be there afterwards: look again. Raises OSError.
    """
    place.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        pauses = waiting_times()
        while True:
            try:
                lock = stack.enter_context(exclusive(lock_file(place), lease=True, remove=True))
                break
            except Held:
                if not wait:
                    raise
                time.sleep(next(pauses))
        for left in place.parent.glob(f"{place.name}.scratch.*"):
            shutil.rmtree(left, ignore_errors=True)
        held = Claim(place, lock)
        try:
            yield held
        finally:
            if "scratch" in vars(held):
                shutil.rmtree(held.scratch, ignore_errors=True)


def lock_file(place: Path) -> Path:
    return place.with_name(f"{place.name}.lock")


def living_claim(directory: Path) -> Held | None:
    """A claim of something in `directory` that a living process holds; None without any."""
    for path in sorted(directory.glob("*.lock")):
        try:
            with exclusive(path, lease=True, remove=True):
                pass
        except Held as held:
            return held
    return None


def waiting_times() -> Iterator[float]:
    """Seconds to wait before the next check, for ever."""
    pause = MIN_WAIT
    while True:
        yield pause
        pause = min(1.5 * pause, MAX_WAIT)
