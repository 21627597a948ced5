"""What becomes of an error, and of an output that nobody reads."""

from __future__ import annotations

import io
import logging
import os

import jax
import pytest

from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import console
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.user_code import called_from_program
from hma_jax.training.checkpoints import SaveError


@pytest.fixture
def emptied():
    """What the console could not write waits for the next line, which is another test's."""
    yield
    with console.capture():
        pass


@pytest.mark.usefixtures("emptied")
@pytest.mark.parametrize("say", [print, console.print])
def test_an_output_that_nobody_reads_ends_the_program_as_sigpipe_would(say, capfd, monkeypatch):
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as pipe, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", pipe)
        assert exit_code_of(lambda: say("a line")) == Exit.UNREAD == 141
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("emptied")
@pytest.mark.parametrize("say", [print, console.print])
def test_a_full_disk_under_the_output_is_said_of_the_output(say, capsys, monkeypatch):
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", full)
        assert exit_code_of(lambda: say("a line")) == Exit.FAILED
    assert capsys.readouterr().err.startswith("error: standard output: No space left on device")


def test_another_pipe_that_breaks_is_an_error(capsys):
    ours, theirs = os.pipe()
    os.close(ours)
    with open(theirs, "wb", buffering=0) as pipe:
        assert exit_code_of(lambda: pipe.write(b"x")) == Exit.FAILED
    assert capsys.readouterr().err.startswith("error: Broken pipe")


def test_too_little_memory_is_one_line_that_says_what_needs_less(capsys):
    def work() -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 7 bytes.\nBacktrace:\n 0x0")

    assert exit_code_of(work) == Exit.REFUSED
    error = capsys.readouterr().err
    assert error.startswith("error: RESOURCE_EXHAUSTED: Out of memory allocating 7 bytes. (") and error.count("\n") == 1
    assert "execution.accumulate=2" in error and "`hma plan` says" in error


def test_another_error_of_the_runtime_is_a_bug():
    def work() -> None:
        raise jax.errors.JaxRuntimeError("INTERNAL: of the compiler")

    with pytest.raises(jax.errors.JaxRuntimeError):
        exit_code_of(work)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ConfigError("no number"), Exit.REFUSED, "error: no number\n"),
        (KeyboardInterrupt(), Exit.INTERRUPTED, "interrupt"),
    ],
)
def test_an_error_on_the_host_within_a_compiled_program_is_what_it_is_elsewhere(error, code, said, capsys):
    """It was JAX's, a bug with its traceback."""

    def fail(x):
        with called_from_program():
            raise error

    def work() -> None:
        jax.block_until_ready(jax.pure_callback(fail, jax.ShapeDtypeStruct((), "float32"), 1.0))

    assert exit_code_of(work) == code
    assert capsys.readouterr().err.startswith(said)
    with pytest.raises(ZeroDivisionError):  # it has been said
        exit_code_of(lambda: 1 / 0)


@pytest.mark.parametrize(("passing", "code"), [(True, Exit.LOST), (False, Exit.FAILED)])
def test_a_disk_that_does_not_answer_is_worth_another_start_and_a_full_one_is_not(passing, code):
    def work() -> None:
        raise SaveError("the checkpoint of step 4 could not be written", passing)

    assert exit_code_of(work) == code


def test_a_message_is_the_same_line_whatever_libraries_have_done_to_the_log(capsys):
    """It began with WARNING:hma_jax.tokenizers.python: in some commands."""
    other = logging.StreamHandler()
    other.setFormatter(logging.Formatter(logging.BASIC_FORMAT))
    logging.root.addHandler(other)
    try:
        assert exit_code_of(lambda: logging.getLogger("hma_jax.x").warning("the tokenizer runs code")) == Exit.DONE
    finally:
        logging.root.removeHandler(other)
    assert capsys.readouterr().err == "the tokenizer runs code\n"


def test_a_message_goes_where_a_progress_bar_has_put_standard_error(monkeypatch, capsys):
    """It was written into the line of the bar, at its end."""
    above_the_bar = io.StringIO()

    def work():
        monkeypatch.setattr("sys.stderr", above_the_bar)
        logging.getLogger("hma_jax.x").warning("an action is clipped")

    assert exit_code_of(work) == Exit.DONE
    assert above_the_bar.getvalue() == "an action is clipped\n"
    assert capsys.readouterr().err == ""


def test_every_program_refuses_a_path_that_is_not_utf8_before_its_work(monkeypatch, capsys):
    """`python -m experiments.applications.ship` ended in a traceback, and called it a lack of space."""
    monkeypatch.setattr("sys.argv", ["ship", "run", "--out", os.fsdecode(b"caf\xe9")])
    assert exit_code_of(lambda: 1 / 0) == Exit.REFUSED
    assert capsys.readouterr().err.startswith("error: caf\\xe9 is not UTF-8")
    assert exit_code_of(lambda: None, arguments=["run"]) == Exit.DONE
