"""Exit codes are documented, and what shells and schedulers take them for."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from hma_jax.runtime.exits import Exit, Terminated, exit_of_interrupt, terminated_like_interrupted

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"


def test_every_code_is_documented():
    page = PAGE.read_text()
    missing = [code.name for code in Exit if f"| {int(code)} | `{code.name}` |" not in page]
    assert not missing, f"{PAGE.name} lacks {', '.join(missing)}"
    assert len(set(Exit)) == len(Exit)


def test_sigterm_ends_a_block_as_ctrl_c_does_with_a_code_of_its_own():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt) as stopped, terminated_like_interrupted():
        os.kill(os.getpid(), signal.SIGTERM)
    assert stopped.type is Terminated and exit_of_interrupt(stopped.value) == Exit.STOPPED == 143
    assert exit_of_interrupt(KeyboardInterrupt()) == Exit.INTERRUPTED == 130
    assert signal.getsignal(signal.SIGTERM) is before
