"""Modules that are programs of their own (`python -m MODULE`), found by the function that they run."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.terminal.command_line import run_module

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"^    run_module\((\w+), __doc__\)$", re.MULTILINE)


def command_of(path: Path) -> str | None:
    """The name of the function that the module at `path` runs; None for one that is no such program."""
    found = COMMAND.search(path.read_text())
    return found and found[1]


def programs() -> list[str]:
    """The names of all modules that are programs."""
    paths = (path for path in sorted((ROOT / "experiments").rglob("*.py")) if command_of(path))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__") for path in paths]


def run_program(
    name: str, arguments: Sequence[str], change: Callable[[Callable[..., None]], Callable[..., None]] = lambda f: f
) -> None:
    """Runs a program with these arguments, in place of its function what `change` makes of it."""
    module = importlib.import_module(name)
    if hasattr(module, "__path__"):
        module = importlib.import_module(f"{name}.__main__")
    command = command_of(Path(module.__file__))
    run_module(change(getattr(module, command)), module.__doc__, arguments)
