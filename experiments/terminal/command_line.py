"""How command lines are read and help texts are printed, alike for all commands; tyro does the rest.

Each command is parsed on its own, so an error names only that command's options and help, not those of all commands.
"""

from __future__ import annotations

import inspect
import io
import itertools
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TextIO, Union, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo
from tyro.extras import SubcommandApp

from experiments.terminal.progress import OUTPUT
from hma_jax.runtime.files import naming

VALUES = {int: "N", float: "NUMBER", str: "NAME", Path: "PATH"}
"""How help texts name a value that its option does not name."""

BORDER = "│╭╰"

BREAK = "\x00"

HEADING = re.compile(r"(Question|Paper|Command|Cost|Expected): ")
"""What begins a paragraph in the help of a module, though its docstring only begins a line with it."""

REPEATED = ("--set", "--launcher-set")
"""Options that take one 'path=value' each time."""

STYLE = re.compile("\x1b\\[[0-9;]*m")
"""What a terminal reads as colours."""


class Commands(SubcommandApp):
    """Commands by name, some of them groups of others."""

    def run(self, prog: str, arguments: Sequence[str], description: str | None = None) -> None:
        """Runs the command that the arguments name. Exits with a message if they are wrong, and after printing a help
        text."""
        with _reading(arguments):
            self._run(prog, list(arguments), description)

    def _run(self, prog: str, arguments: list[str], description: str | None) -> None:
        found = self._subcommands.get(arguments[0]) if arguments else None
        if found is None:
            self._join_lines()
            self.cli(prog=prog, description=description, args=arguments)
            return
        prog, arguments = f"{prog} {arguments[0]}", arguments[1:]
        if isinstance(found.target, Commands):
            found.target._run(prog, arguments, found.help)
        else:
            _run_command(found.target, prog, arguments, found.help)

    def _join_lines(self) -> None:
        for found in self._subcommands.values():
            if isinstance(found.target, Commands):
                found.target._join_lines()
            else:
                _join_lines(found.target)


def run_module(command: Callable[..., None], description: str, arguments: Sequence[str] | None = None) -> None:
    """The main of a module that is a program of its own: runs `command` with the arguments, by default those of the
    process. `description`: the module's docstring, which its help shows. Exits as `Commands.run`."""
    name = command.__module__
    if name == "__main__" and (spec := sys.modules[name].__spec__) is not None:
        name = spec.name
    arguments = sys.argv[1:] if arguments is None else arguments
    with _reading(arguments):
        _run_command(command, f"python -m {name.removesuffix('.__main__')}", list(arguments), joined(description))


def repeat_option(arguments: Sequence[str]) -> str:
    """What to write instead if an option of `REPEATED` was given once for several settings, or with a space in place of
    '='; '' if neither is the case."""
    for n, option in enumerate(arguments):
        if option not in REPEATED:
            continue
        given = [*itertools.takewhile(lambda word: not word.startswith("-"), arguments[n + 1 :])]
        settings = [word for word in given if re.match(r"[\w.]+=", word)]
        if len(given) > 1 and "=" not in given[0] and given[0].split(".")[-1] != "help":  # which takes no value
            settings = [f"{given[0]}={given[1]}"]
        elif len(settings) < 2:
            continue
        words = " ".join(f"{option} {one}" for one in settings)
        return f"{option} takes one setting and is repeated for others: {words}"
    return ""


def joined(doc: str) -> str:
    """A docstring with every paragraph and every argument on one line, which the help text breaks where needed.
    'Default: X.' at the end of an argument becomes '(default: X)', as tyro writes it."""
    lines: list[str] = []
    arguments = False
    for line in inspect.cleandoc(doc).splitlines():
        depth = len(line) - len(line.lstrip())
        goes_on = depth > 4 if arguments else True
        if lines and lines[-1] and HEADING.match(line):
            lines.append("")
        if lines and lines[-1] and line and goes_on and lines[-1] != "Args:":
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line)
        arguments |= line == "Args:"
    return "\n".join(re.sub(r"^( +.*) Default: (.*)\.$", r"\1 (default: \2)", line) for line in lines)


def _join_lines(function: Callable[..., Any]) -> None:
    function.__doc__ = joined(function.__doc__ or "")  # where tyro reads the help


def _run_command(command: Callable[..., Any], prog: str, arguments: list[str], description: str | None) -> None:
    _join_lines(command)
    tyro.cli(command, prog=prog, description=description, args=arguments)


@contextmanager
def _reading(arguments: Sequence[str]) -> Iterator[None]:
    """What holds while tyro reads arguments and prints help texts."""
    with _values(), _wrapped() if {"-h", "--help"} & set(arguments) else nullcontext():
        try:
            yield
        except SystemExit as end:
            if end.code and (advice := repeat_option(arguments)):
                print(f"error: {advice}", file=sys.stderr)
            raise


def wrapped(text: str, width: int) -> str:
    """A help text in which the lines outside its boxes are broken too: tyro prints those as they are."""
    lines = []
    for styled in text.splitlines():
        line = STYLE.sub("", styled)
        if len(line) <= width or line.startswith(tuple(BORDER)):
            lines.append(styled)
            continue
        indent = len("usage: ") * " " if line.startswith("usage: ") else ""
        line = re.sub(r"([,|])(?=\S)", rf"\1 {BREAK}", line)  # names of choices
        parts = textwrap.wrap(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        lines += [re.sub(f"(?<=[,|]) {BREAK}|{BREAK}", "", part) for part in parts]
    return "\n".join(lines) + "\n"


class _Caught(io.StringIO):
    """Collects what is printed, and has the properties of the stream for which it was meant."""

    def __init__(self, stream: TextIO):
        super().__init__()
        self._stream = stream

    def isatty(self) -> bool:
        return self._stream.isatty()

    @property
    def encoding(self) -> str | None:
        return self._stream.encoding


@contextmanager
def _wrapped() -> Iterator[None]:
    stream = sys.stdout
    caught = _Caught(stream)
    try:
        with redirect_stdout(caught):
            yield
    finally:
        if text := caught.getvalue():
            with naming(OUTPUT):
                stream.write(wrapped(text, shutil.get_terminal_size().columns))


def _values() -> ConstructorRegistry:
    """Rules that make help texts name values as in `VALUES`, also for options that may be left out."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def plain(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        name = VALUES.get(info.type) if isinstance(info.type, type) else None
        if name is None:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=name,
            instance_from_str=lambda words: info.type(words[0]),
            is_instance=lambda value: isinstance(value, (int, float) if info.type is float else info.type),
            str_from_instance=lambda value: [str(value)],
        )

    @registry.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        types = get_args(info.type) if info.type_origin in (Union, UnionType) else ()
        given = [one for one in types if one is not NoneType]
        if len(given) != 1 or len(types) != 2:
            return None
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(given[0], info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return None
        return replace(
            spec,
            is_instance=lambda value: value is None or spec.is_instance(value),
            str_from_instance=lambda value: ["none"] if value is None else spec.str_from_instance(value),
        )

    return registry
