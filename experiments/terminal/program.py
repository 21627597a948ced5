"""The program's name, and how the modules that it imports start it: by its name, so none imports in a circle."""

from __future__ import annotations

import io
import os
import re
import runpy
import shlex
import sys

PROGRAM = "hma"


def run_sweep(axis: str) -> None:
    """The main of an experiment module: `python -m experiments.sweeps.width` is `hma sweep width`."""
    before, asked = sys.argv, ["sweep", axis, *sys.argv[1:]]
    if is_program():
        os.execv(sys.executable, [sys.executable, "-m", "experiments.cli", *asked])
    sys.argv = [*before[:1], *asked]
    try:
        runpy.run_module("experiments.cli", run_name="__main__")
    finally:
        sys.argv = before


def is_program() -> bool:
    """Whether Python was started for this program alone: by its script, or with `-m`. Otherwise, as under `runpy` or
    `%run` of a notebook, starting another one in this process would lose all that it holds."""
    started = " ".join(sys.orig_argv[1 : len(sys.orig_argv) - len(sys.argv) + 1])  # without the program's arguments
    return re.search(rf"(^|[ /]){PROGRAM}$|(^| )-\w*m ?experiments\.[\w.]+$", started) is not None


def prepare_output() -> None:
    """What is written to standard output or standard error goes nowhere where these are closed, as by `>&-`. Characters
    that the locale lacks are printed as `?`: a dash in a table ends no command."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # not a notebook's
        sys.stdout.reconfigure(errors="replace")


def command_line() -> str:
    """The command as typed, whichever way the program was started; of another program that uses this one, its own."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = spec.name if spec else ""
    own = module.startswith("experiments.")
    if own and not module.startswith("experiments.cli"):
        return shlex.join(["python", "-m", module, *sys.argv[1:]])
    return shlex.join([PROGRAM, *sys.argv[1:]] if own or is_program() else sys.orig_argv)
