"""How every program of this project ends: its exit codes, declared here and listed in docs/reliability.md."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from types import FrameType

IMPORTER = "<frozen importlib._bootstrap>"
COMPILER = "compile_or_get_cached"
"""JAX's function around the compiler, in its file compiler.py."""

LOOK_EVERY = 0.05
"""Seconds between two looks whether what a request to stop waits for has ended."""


class Exit(IntEnum):
    """What a scheduler is told. Codes of signals are those that shells give them."""

    DONE = 0
    FAILED = 1  # the work could not be done: data, disk, a trial
    REFUSED = 2  # wrong arguments or configuration, or a directory that another process holds
    DIVERGED = 3  # a number was not finite: the same command would end so again
    # EX_TEMPFAIL. Another process of the same program is lost or failed: start all of them again. Of the process of a
    # trial: its files could not be written.
    LOST = 75
    UNREAD = 128 + signal.SIGPIPE  # whoever read the output does so no more, as `| head`
    INTERRUPTED = 128 + signal.SIGINT  # Ctrl-C; what could be saved is, and the same command goes on
    STOPPED = 128 + signal.SIGTERM  # the same, asked for by SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM, as schedulers send it: a program ends as it does on Ctrl-C."""


_raised: list[Exit] = []
"""Requests whose exceptions were raised in a block that has not ended, or that were handed on there."""

_blocks = 0
"""Of `terminated_like_interrupted`, that have not ended."""


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM raises Terminated in the main thread while the block runs; by default the process would just be gone.

    It waits for imports to end, and so does Ctrl-C: an exception in the middle of one is lost where a library tries
    what it can import, leaves half a module, or ends the process by a signal in a library's C code. It waits for the
    compiler too, which cannot be interrupted: raised between its end and the use of the program that it made, an
    exception loses the program, and the process ends by a segmentation fault.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        if _waits(frame):
            again = threading.Timer(LOOK_EVERY, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return
        _raised.append(Exit(128 + number))
        raise KeyboardInterrupt if number == signal.SIGINT else Terminated

    global _blocks
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may install handlers
        return
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, stop)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # otherwise it is ignored, or handled already
        before[signal.SIGINT] = signal.signal(signal.SIGINT, stop)
    _blocks += 1
    try:
        yield
    finally:
        _blocks -= 1
        _raised.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def hand_on(request: Exit) -> None:
    """A request to stop that came too late for what had taken the signals for itself: `lost_request` tells what comes
    after it. Where no block of `terminated_like_interrupted` asks for that, it is forgotten."""
    if _blocks:
        _raised.append(request)


def lost_request() -> Exit | None:
    """A request to stop whose exception has come to nothing, as it does in a callback of a library, or that was handed
    on; told once.

    For what takes long to ask now and then, before it ends a block of `terminated_like_interrupted` itself.
    """
    request = _raised[-1] if _raised else None
    _raised.clear()
    return request


def raise_lost_request() -> None:
    """In the main thread; others have no requests."""
    if threading.current_thread() is not threading.main_thread():
        return
    if (request := lost_request()) is not None:
        raise KeyboardInterrupt if request == Exit.INTERRUPTED else Terminated


def _waits(frame: FrameType | None) -> bool:
    """Whether it imports or compiles."""
    while frame is not None:
        code = frame.f_code
        if code.co_filename == IMPORTER or (code.co_name == COMPILER and code.co_filename.endswith("compiler.py")):
            return True
        frame = frame.f_back
    return False


def exit_of_interrupt(request: KeyboardInterrupt) -> Exit:
    return Exit.STOPPED if isinstance(request, Terminated) else Exit.INTERRUPTED
