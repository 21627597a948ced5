"""What becomes of an error, and of an output that nobody reads."""

from __future__ import annotations

import os

import pytest

from experiments.boundary import guarded
from experiments.progress import console
from hma_jax.runtime.exits import Exit


@pytest.mark.parametrize("say", [print, console.print])
def test_an_output_that_nobody_reads_ends_the_program_as_sigpipe_would(say, capfd, monkeypatch):
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as pipe, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", pipe)
        assert guarded(lambda: say("a line")) == Exit.UNREAD == 141
    assert capfd.readouterr().err == ""


def test_another_pipe_that_breaks_is_an_error(capsys):
    ours, theirs = os.pipe()
    os.close(ours)
    with open(theirs, "wb", buffering=0) as pipe:
        assert guarded(lambda: pipe.write(b"x")) == Exit.FAILED
    assert capsys.readouterr().err.startswith("error: Broken pipe")
