"""The program's name, and how the modules that it imports start it: by becoming it, so that
nothing imports in a circle."""

from __future__ import annotations

import os
import shlex
import sys
from typing import NoReturn

PROGRAM = "hma"


def run_sweep(axis: str) -> NoReturn:
    """The main of an experiment module: `python -m experiments.sweeps.width` is `hma sweep width`."""
    os.execv(sys.executable, [sys.executable, "-m", "experiments.cli", "sweep", axis, *sys.argv[1:]])


def command_line() -> str:
    """The command as typed, whichever way the program was started."""
    return shlex.join([PROGRAM, *sys.argv[1:]])
