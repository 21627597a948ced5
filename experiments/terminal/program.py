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
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = spec.name if spec else ""
    own = module.startswith("experiments.") and not module.startswith("experiments.cli")
    return shlex.join([*(["python", "-m", module] if own else [PROGRAM]), *sys.argv[1:]])
