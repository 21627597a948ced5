"""A call in a process of its own: the memory and accelerators that the process took are free when the call returns."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import traceback
from collections.abc import Callable
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

from experiments.running.children import enter_child
from experiments.running.launchers.base import GRACE_SECONDS
from experiments.terminal.messages import background_is_silent, plain_messages, silence_background
from hma_jax.runtime.exits import Terminated, sigterm_as_interrupt

T = TypeVar("T")


def call_in_subprocess(what: str, function: Callable[..., T], *arguments: Any) -> T:
    """Returns or raises what function(*arguments) returns or raises in a new process, which has ended by then.

    Everything is pickled. Ctrl-C and SIGTERM are passed on, and what the function raises for them is raised here.
    Raises ChildProcessError if the process ends without an answer; `what` it was for ("prepares the data") is in the
    message.
    """
    context = multiprocessing.get_context("spawn")  # a fork would have what JAX's threads hold
    receiver, sender = context.Pipe(duplex=False)
    of_this = (os.getpid(), background_is_silent())
    process = context.Process(target=_answer, args=(sender, of_this, function, arguments))
    answered = False
    try:
        _start(process)
        sender.close()
        returned, value = _receive(receiver, process, what)
        answered = True
    finally:
        sender.close()
        if process.pid is not None:
            try:
                process.join(GRACE_SECONDS if answered else 0)
            finally:
                process.kill()
                process.join()
    if not returned:
        raise value
    return value


def _start(process: SpawnProcess) -> None:
    """Starts the process with SIGINT blocked: until it has a session of its own, a terminal sends Ctrl-C to it too, and
    together with the one that is passed on it would get two."""
    resource_tracker.ensure_running()  # whose start unblocks SIGINT: before
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _receive(receiver: Connection, process: SpawnProcess, what: str) -> tuple[bool, Any]:
    """(whether the function returned, its result or exception)."""
    try:
        receiver.poll(None)
        return receiver.recv()
    except KeyboardInterrupt as request:
        os.kill(process.pid, signal.SIGTERM if isinstance(request, Terminated) else signal.SIGINT)
        try:
            if not receiver.poll(GRACE_SECONDS):
                raise
            returned, value = receiver.recv()
        except EOFError:
            raise request from None
        return False, request if returned else value  # it may have saved something, and say so
    except EOFError:
        process.join()
        code = process.exitcode
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        why = ", perhaps for lack of memory" if code == -signal.SIGKILL else ""
        raise ChildProcessError(
            f"the process that {what} {how}{why}; the same command continues where it was"
        ) from None


def _answer(
    sender: Connection, of_parent: tuple[int, bool], function: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    """Runs in the new process. `of_parent`: the parent's process number, and whether it is silent."""
    parent, silent = of_parent
    try:
        os.setsid()  # Ctrl-C in a terminal reaches only the parent, which passes it on
        enter_child(parent)
        if silent:
            silence_background()
        with sigterm_as_interrupt(), plain_messages():
            answer = True, function(*arguments)
    except BaseException as error:  # also exceptions that end a process: the parent raises them
        answer = False, _portable(error)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it is done
    sender.send(answer)


def _portable(error: BaseException) -> BaseException:
    """`error` with its traceback as a note; a RuntimeError with the same words if it cannot be sent."""
    trace = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever its class raises when it is rebuilt
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"in another process:\n{trace}")
    return error
