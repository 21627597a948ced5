"""Exit codes are documented, and what shells and schedulers take them for."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest
from jax._src import compiler

from hma_jax.runtime.exits import Exit, Terminated, exit_of_interrupt, raise_pending_stop, sigterm_as_interrupt

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"


def test_every_code_is_documented():
    page = PAGE.read_text()
    missing = [code.name for code in Exit if f"| {int(code)} | `{code.name}` |" not in page]
    assert not missing, f"{PAGE.name} lacks {', '.join(missing)}"
    assert len(set(Exit)) == len(Exit)


@pytest.mark.usefixtures("hangup_heard")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_sighup_end_a_block_as_ctrl_c_does_with_a_code_of_their_own(number):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt) as stopped, sigterm_as_interrupt():
        assert signal.getsignal(number) is not signal.SIG_DFL
        os.kill(os.getpid(), number)
    assert stopped.type is Terminated and exit_of_interrupt(stopped.value) == Exit.STOPPED == 143
    assert exit_of_interrupt(KeyboardInterrupt()) == Exit.INTERRUPTED == 130
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("hangup_heard")
def test_what_is_printed_on_a_closed_terminal_does_not_keep_a_program_from_saving(tmp_path: Path):
    program = (
        "import fcntl, sys, termios, time; from hma_jax.runtime.exits import exit_of_interrupt, sigterm_as_interrupt\n"
        "fcntl.ioctl(1, termios.TIOCSCTTY, 0)\n"  # its closing sends SIGHUP
        "try:\n"
        "    with sigterm_as_interrupt():\n"
        "        print('at work', flush=True)\n"
        "        time.sleep(60)\n"
        "except KeyboardInterrupt as request:\n"
        "    print('saving', flush=True)\n"
        "    print('saving', file=sys.stderr, flush=True)\n"
        "    sys.exit(exit_of_interrupt(request))"
    )
    terminal, its = pty.openpty()
    process = subprocess.Popen([sys.executable, "-c", program], stdout=its, stderr=its, start_new_session=True)
    os.close(its)
    said = b""
    while b"at work" not in said:
        said += os.read(terminal, 1000)
    os.close(terminal)
    assert process.wait(30) == Exit.STOPPED


@pytest.mark.usefixtures("hangup_heard")
def test_a_second_sighup_does_not_interrupt_what_the_first_began():
    """A shell whose terminal is closed sends it to its jobs, and the system does once more when the shell ends."""
    saved = []
    with pytest.raises(Terminated), sigterm_as_interrupt():
        try:
            os.kill(os.getpid(), signal.SIGHUP)
        finally:
            os.kill(os.getpid(), signal.SIGHUP)
            saved.append(True)
    assert saved


def test_under_nohup_sighup_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with sigterm_as_interrupt():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, Exit.INTERRUPTED), (signal.SIGTERM, Exit.STOPPED)])
def test_a_request_to_stop_waits_for_the_import_that_it_meets(number, code, tmp_path, monkeypatch):
    """A library that tries what it can import would take the exception for a failure, and the request would be lost."""
    name = f"asked_by_{number.name.lower()}"
    (tmp_path / f"{name}.py").write_text(f"import os\nos.kill(os.getpid(), {int(number)})\nwhole = sum(range(10**5))\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt) as stopped, sigterm_as_interrupt():
        try:
            module = __import__(name)
        except BaseException as error:
            raise AssertionError("the import was interrupted") from error
        time.sleep(60)
    assert module.whole and exit_of_interrupt(stopped.value) == code
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number, code", [(signal.SIGINT, Exit.INTERRUPTED), (signal.SIGTERM, Exit.STOPPED)])
def test_a_request_to_stop_waits_for_the_program_that_is_compiled(number, code, monkeypatch):
    """The compiler's program would be lost with the exception, and the process end by a segmentation fault."""
    real, compiled = compiler.backend_compile_and_load, []

    def compile_and_load(*arguments, **options):
        os.kill(os.getpid(), number)
        return compiled.append(real(*arguments, **options)) or compiled[-1]

    monkeypatch.setattr(compiler, "backend_compile_and_load", compile_and_load)
    monkeypatch.setattr(compiler.compilation_cache, "is_cache_used", lambda backend: False)
    with pytest.raises(KeyboardInterrupt) as stopped, sigterm_as_interrupt():
        jax.jit(lambda x: x + int(number))(1.0)
        time.sleep(10)
    assert len(compiled) == 1 and exit_of_interrupt(stopped.value) == code


@pytest.mark.parametrize("number, code", [(signal.SIGINT, Exit.INTERRUPTED), (signal.SIGTERM, Exit.STOPPED)])
def test_a_request_that_came_to_nothing_is_raised_again_once(number, code):
    """In a callback of a library, a finaliser say, exceptions are lost."""
    raise_pending_stop()
    with pytest.raises(KeyboardInterrupt) as stopped, sigterm_as_interrupt():
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        raise_pending_stop()
    assert exit_of_interrupt(stopped.value) == code
    raise_pending_stop()
