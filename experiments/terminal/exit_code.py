"""The boundary of a program: what an error becomes. Exit codes are those of `hma_jax.runtime.exits`."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress

from data_pipelines.errors import DataError, EpisodeError
from experiments.terminal.messages import plain_messages, silence_background
from experiments.terminal.program import prepare_output
from experiments.terminal.progress import OUTPUT, errors
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit, exit_of_interrupt, sigterm_as_interrupt
from hma_jax.runtime.files import naming
from hma_jax.runtime.user_code import raising_as_called

OUT_OF_MEMORY = (
    "(The memory of a device is too small for this. Training needs less with --set execution.remat=everything, "
    "--set execution.accumulate=2 or more, a smaller train.batch, or --mesh 1 -1 1, which splits weights and moments among "
    "devices; `hma plan` says how much it needs. Evaluation needs less with a smaller eval.batch. Another "
    "program on the device may hold the rest.)"
)
"""Added to what the compiler or a device says."""


class TrialsFailed(Exception):
    """The sweep ran to its end, but some trials have no result. `exit`: the command's exit code."""

    def __init__(self, message: str, exit: Exit = Exit.FAILED):
        super().__init__(message)
        self.exit = exit


def exit_code_of(
    work: Callable[[], None],
    debug: bool = False,
    own_process: bool = True,
    *,
    arguments: Sequence[str] | None = None,
    resumes: bool = True,
    keeps: str = "",
    skipping: str = "",
) -> int:
    """Does `work` and returns the exit code. Errors that a user can fix become one message on stderr; with `debug` or
    HMA_DEBUG=1 they give a traceback, as bugs do. `own_process`: the process has nothing else to do. `arguments`: the
    program's, by default those of the process; none may be a path that is not UTF-8. `resumes`: after a stop the same
    command continues where it was; otherwise it begins anew and keeps what `keeps` names. `skipping`: the option that
    leaves out records that cannot be read."""
    prepare_output()
    debug = debug or os.environ.get("HMA_DEBUG", "0") not in ("", "0")
    if own_process and not debug:
        silence_background()
    try:
        with sigterm_as_interrupt(), plain_messages() if own_process else nullcontext():
            try:
                _require_utf8(sys.argv[1:] if arguments is None else arguments)
                with raising_as_called():
                    work()
            except SystemExit:  # as by --help
                _flush()
                raise
            _flush()  # not later, where nothing catches its errors
            _end_together()
        return Exit.DONE
    except BrokenPipeError as error:
        if not _unread():
            return _failed(error, debug, skipping)
        _discard_output()
        _end_together(error, Exit.UNREAD)
        return Exit.UNREAD
    except KeyboardInterrupt as request:
        code = exit_of_interrupt(request)
        what = "stopped by a signal" if code == Exit.STOPPED else "interrupted"
        anew = f"starts again from the beginning, but keeps {keeps}" if keeps else "begins anew"
        _say(f"{what}; the same command {'continues from here' if resumes else anew}")
        _end_together(request, code)
        return code
    except Exception as error:  # the boundary of the program
        if isinstance(error, OSError) and error.filename == str(OUTPUT):
            _discard_output()
        return _failed(error, debug, skipping)


def _require_utf8(arguments: Sequence[str]) -> None:
    """Raises ConfigError for a path that is not UTF-8, including the working directory: checkpoints cannot be kept
    there."""
    here = ""
    with suppress(OSError):  # the working directory was removed
        here = os.getcwd()
    for text in (*arguments, here):
        try:
            text.encode()
        except UnicodeEncodeError as error:
            shown = os.fsencode(text).decode(errors="backslashreplace")
            raise ConfigError(
                f"{shown} is not UTF-8, and checkpoints cannot be written or read under such a name; rename the "
                "directory, or use another one"
            ) from error


def _failed(error: Exception, debug: bool, skipping: str) -> int:
    """Prints what is wrong, and returns the exit code. Raises `error` again if it is a bug, or with `debug`."""
    code = _exit_code(error)
    if debug or code is None:
        _end_together(error, code or Exit.FAILED, show=True)
        raise error
    _say(f"error: {_words(error, skipping)}")
    _end_together(error, code)
    return code


def _flush() -> None:
    with naming(OUTPUT):
        sys.stdout.flush()


def _discard_output() -> None:
    """Discards what is left in the output's buffers; Python would try to write it when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _unread() -> bool:
    """Whether standard output is a pipe or socket whose reader is gone; other pipes can break too."""
    try:
        number = sys.stdout.fileno()
    except (OSError, ValueError):  # a test's
        return False
    poller = select.poll()
    poller.register(number, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poller.poll(0))


def _end_together(error: BaseException | None = None, code: int = Exit.DONE, show: bool = False) -> None:
    """Ends together with the other processes, if there are any: none is left waiting for one that ends."""
    if "hma_jax.runtime.processes" not in sys.modules:  # none was started
        return
    from hma_jax.runtime.processes import end
    from hma_jax.training.loop import Interrupted

    # A requested stop stops all processes, after the same step.
    end(None if isinstance(error, Interrupted) else error, code, show)


def _exit_code(error: Exception) -> Exit | None:
    """The exit code of an error that a user can fix; None for a bug, which is shown with its traceback."""
    if isinstance(error, ConfigError):
        return Exit.REFUSED
    if isinstance(error, TrialsFailed):
        return error.exit
    if "jax" in sys.modules:  # otherwise none of these can have been raised
        from hma_jax.training.checkpoints import SaveError
        from hma_jax.training.divergence import DivergedError
        from hma_jax.training.loop import Interrupted

        if isinstance(error, DivergedError):
            return Exit.DIVERGED
        if isinstance(error, Interrupted):
            return error.exit
        if isinstance(error, SaveError) and error.passing:
            return Exit.LOST
        if _is_out_of_memory(error):
            return Exit.REFUSED
    if isinstance(error, (DataError, OSError)):
        return Exit.FAILED
    return None


def _is_out_of_memory(error: Exception) -> bool:
    """Whether a device has too little memory for a program or an array."""
    import jax

    return isinstance(error, jax.errors.JaxRuntimeError) and str(error).startswith("RESOURCE_EXHAUSTED")


def _words(error: Exception, skipping: str) -> str:
    """The message of an error, and what it cannot know: how its advice is followed from here."""
    if isinstance(error, EpisodeError) and skipping:
        return f"{error} (Here: {skipping}.)"
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror}; check the path, its permissions and the space on its disk"
    if "jax" in sys.modules and _is_out_of_memory(error):
        return f"{str(error).splitlines()[0]} {OUT_OF_MEMORY}"
    return str(error)


def _say(message: str) -> None:
    errors.print(message, markup=False, soft_wrap=True)
