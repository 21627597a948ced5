"""How every program of this project ends: its exit codes, declared here and listed in docs/reliability.md."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum


class Exit(IntEnum):
    """What a scheduler is told. Codes of signals are those that shells give them."""

    DONE = 0
    FAILED = 1  # the work could not be done: data, disk, a trial
    REFUSED = 2  # wrong arguments or configuration, or a directory that another process holds
    DIVERGED = 3  # a number was not finite: the same command would end so again
    LOST = 75  # another process of the same program is lost or failed (EX_TEMPFAIL): start all of them again
    INTERRUPTED = 128 + signal.SIGINT  # Ctrl-C; what could be saved is, and the same command goes on
    STOPPED = 128 + signal.SIGTERM  # the same, asked for by SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM, as schedulers send it: a program ends as it does on Ctrl-C."""


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM raises Terminated in the main thread while the block runs; by default the process would just be gone."""

    def stop(number: int, frame: object) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may install handlers
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def exit_of_interrupt(request: KeyboardInterrupt) -> Exit:
    return Exit.STOPPED if isinstance(request, Terminated) else Exit.INTERRUPTED
