"""The exit codes of all programs of this project, listed in docs/reliability.md, and how signals stop a program."""

from __future__ import annotations

import errno
import os
import signal
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from types import FrameType

IMPORTER = "<frozen importlib._bootstrap>"
COMPILER = "compile_or_get_cached"
"""JAX's function around the compiler, in its file compiler.py."""

RETRY_EVERY = 0.05
"""Seconds after which a signal that arrived during an import or a compilation is delivered again."""


class Exit(IntEnum):
    """What a scheduler is told. Signals have the codes that shells give them."""

    DONE = 0
    FAILED = 1  # the work could not be done: data, disk, a trial
    REFUSED = 2  # wrong arguments or configuration, or a directory that another process holds
    DIVERGED = 3  # a number was not finite: the same command would end in the same way
    # EX_TEMPFAIL. Another process of the same program was lost or failed: start all of them again. Or the disk of a run
    # did not answer for minutes. For the process of a trial: its files could not be written, its data could not be
    # read, or its accelerator failed.
    LOST = 75
    UNREAD = 128 + signal.SIGPIPE  # the reader of the output has closed it, such as `| head`
    INTERRUPTED = 128 + signal.SIGINT  # Ctrl-C; what could be saved is saved, and the same command continues
    STOPPED = 128 + signal.SIGTERM  # the same, requested by SIGTERM or SIGHUP


class Terminated(KeyboardInterrupt):
    """SIGTERM, which schedulers send, or SIGHUP, from a terminal that was closed: the program ends as it does on
    Ctrl-C."""


_pending: list[Exit] = []
"""Stop requests to the running blocks: their exceptions may have been swallowed, or `leave_stop_pending` kept them."""

_active_blocks = 0
"""How many blocks of `sigterm_as_interrupt` are running."""


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """SIGTERM and SIGHUP raise Terminated in the main thread while the block runs; by default they would end the
    process at once. A SIGHUP that is ignored, as under nohup, stays ignored.

    These signals and SIGINT are held back during imports. An exception in the middle of an import may be swallowed by a
    library that tests whether a module exists, leave a module half initialised, or crash a library's C code. They are
    also held back during compilation, which cannot be interrupted: an exception raised before the compiled program is
    used ends the process with a segmentation fault.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        if _in_import_or_compiler(frame):
            again = threading.Timer(RETRY_EVERY, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return
        _pending.append(take_signal(number))
        raise KeyboardInterrupt if number == signal.SIGINT else Terminated

    global _active_blocks
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may install handlers
        return
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, stop)}
    for number, default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is default:  # otherwise it is ignored, or handled already
            before[number] = signal.signal(number, stop)
    _active_blocks += 1
    try:
        yield
    finally:
        _active_blocks -= 1
        _pending.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def leave_stop_pending(request: Exit) -> None:
    """Keeps a stop request that came too late for code with its own signal handlers (the training loop in its last
    step): `take_pending_stop` returns it. Outside `sigterm_as_interrupt` it is dropped."""
    if _active_blocks:
        _pending.append(request)


def take_pending_stop() -> Exit | None:
    """The pending stop request, which is then no longer pending; None if there is none. Its exception was swallowed,
    for example in a library's callback, or it was left pending.

    Long computations inside a block of `sigterm_as_interrupt` should call this from time to time.
    """
    request = _pending[-1] if _pending else None
    _pending.clear()
    return request


def raise_pending_stop() -> None:
    """Raises the pending stop request, if there is one. Does nothing outside the main thread, the only one that
    receives signals."""
    if threading.current_thread() is not threading.main_thread():
        return
    if (request := take_pending_stop()) is not None:
        raise KeyboardInterrupt if request == Exit.INTERRUPTED else Terminated


def _in_import_or_compiler(frame: FrameType | None) -> bool:
    """Whether the interrupted code is inside an import or the compiler."""
    while frame is not None:
        code = frame.f_code
        if code.co_filename == IMPORTER or (code.co_name == COMPILER and code.co_filename.endswith("compiler.py")):
            return True
        frame = frame.f_back
    return False


def take_signal(number: int) -> Exit:
    """The exit code for a stop request by SIGINT, SIGTERM or SIGHUP; called by the handlers of these signals.

    Printing to a closed terminal would raise OSError before anything is saved, so output to it is discarded from now
    on. A closed terminal sends SIGHUP through its shell, and again when the shell ends, so further ones are ignored.
    """
    if number == signal.SIGHUP:
        signal.signal(number, signal.SIG_IGN)
    for stream in (1, 2):
        try:
            termios.tcgetattr(stream)
        except termios.error as error:
            if error.args[0] != errno.ENOTTY:  # it was a terminal
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    return Exit.INTERRUPTED if number == signal.SIGINT else Exit.STOPPED


def exit_of_interrupt(request: KeyboardInterrupt) -> Exit:
    return Exit.STOPPED if isinstance(request, Terminated) else Exit.INTERRUPTED
