"""How the program and the modules that start it treat the process they run in."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from experiments.terminal.program import command_line, is_program

NOTEBOOK = """
import runpy, sys
print("first cell", flush=True)
hook = sys.unraisablehook
sys.argv = ["notebook", "--help"]
try:
    runpy.run_module({module!r}, run_name="__main__", alter_sys=True)
except SystemExit as end:
    print("\\nnext cell", end.code, sys.argv, sys.unraisablehook is hook)
"""


@pytest.mark.parametrize("module", ["experiments.cli", "experiments.sweeps.width"])
def test_a_process_that_runs_a_module_goes_on_after_it(module):
    """A notebook was replaced by the program, or by itself, and all its variables were lost. Its errors stay heard."""
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    command = [sys.executable, "-c", NOTEBOOK.format(module=module)]
    lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines.count("first cell") == 1 and lines[1].startswith("usage: hma")
    assert lines[-1] == "next cell 0 ['notebook', '--help'] True"


@pytest.mark.parametrize(
    ("started", "arguments", "program"),
    [
        ("python -m experiments.cli", "study --out a", True),
        ("python -u -X dev -mexperiments.sweeps.width", "", True),
        ("python -um experiments.sweeps.width", "", True),
        ("python /venv/bin/hma", "--help", True),
        ("python hma", "", True),
        ("python -m ipykernel_launcher -f kernel.json", None, False),
        ("python /venv/bin/ipython", None, False),
        ("python /home/hma/notes.py", "", False),
        ("python notes.py", "hma", False),
        ("python", None, False),
    ],
)
def test_a_process_is_the_programs_own_if_python_was_started_for_it(started, arguments, program, monkeypatch):
    """None: %run puts the arguments of what it runs in place of the notebook's own."""
    asked = (arguments or "").split()
    monkeypatch.setattr(sys, "orig_argv", [*started.split(), *asked])
    monkeypatch.setattr(sys, "argv", ["file", *asked] if arguments is not None else ["file", "--preset", "smoke"])
    assert is_program() == program


def test_a_dash_that_the_locale_lacks_ends_no_command():
    """The table of `hma judge` did, after hours."""
    printing = r"from experiments.terminal.program import prepare_output as p; p(); print('0.1 \u2013 0.2')"
    environment = os.environ | {"PYTHONIOENCODING": "iso-8859-1"}
    done = subprocess.run([sys.executable, "-c", printing], env=environment, capture_output=True, check=True)
    assert done.stdout == b"0.1 ? 0.2\n"


@pytest.mark.parametrize(
    ("started", "module", "command"),
    [
        ("python /venv/bin/hma judge runs/a", "", "hma judge runs/a"),
        ("python -m experiments.cli judge runs/a", "experiments.cli.__main__", "hma judge runs/a"),
        ("python -m experiments.applications.detector a", "experiments.applications.detector", None),
        ("python -m ipykernel_launcher -f kernel.json", "", None),
        ("python -m their.study runs/a", "their.study", None),
        ("python study.py runs/a", "", None),
    ],
)
def test_a_command_is_that_of_the_process(started, module, command, monkeypatch):
    """Results that a notebook or script had asked for were said to be of `hma -f kernel.json`."""
    words = started.split()
    main = SimpleNamespace(__spec__=SimpleNamespace(name=module) if module else None)
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(sys, "orig_argv", words)
    monkeypatch.setattr(sys, "argv", ["file", *words[3 if words[1] == "-m" else 2 :]])
    assert command_line() == (command or started)
