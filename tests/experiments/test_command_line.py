"""Helps and refusals of every command: as wide as the terminal, in words, about that command alone."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from experiments.cli import main as program
from experiments.terminal.command_line import Commands, joined, wrapped
from tests.experiments.programs import programs, run_program

PYTHON = re.compile(r"\b(None|True|False|STR|INT|FLOAT|BOOL|PATH(?!=))\b|\(default: \)|Default: ")
"""What is no word of a help: types and values of Python, an empty default, a default told in another way."""


def names(app: Commands, *before: str) -> Iterator[tuple[str, ...]]:
    yield before
    for name, found in app._subcommands.items():
        if isinstance(found.target, Commands):
            yield from names(found.target, *before, name)
        else:
            yield (*before, name)


COMMANDS = [*names(program.app), *((name,) for name in programs())]
"""Those of `hma`, and modules that are programs of their own."""


def said_by(capsys, *arguments: str) -> list[str]:
    with pytest.raises(SystemExit) as end:
        if arguments[0].startswith("experiments."):
            run_program(arguments[0], arguments[1:])
        else:
            program.main(arguments)
    out, err = capsys.readouterr()
    assert bool(err) == bool(end.value.code)
    return (out + err).splitlines()


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_no_line_of_a_help_is_wider_than_the_terminal(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert len(COMMANDS) > 40
    wide = {" ".join(c): [w for w in said_by(capsys, *c, "--help") if len(w) > columns] for c in COMMANDS}
    assert not {name: lines for name, lines in wide.items() if lines}


def test_a_help_has_no_types_or_values_of_python(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "120")
    said = {" ".join(c): [w for w in said_by(capsys, *c, "--help") if PYTHON.search(w)] for c in COMMANDS}
    assert not {name: lines for name, lines in said.items() if lines}


def broken(lines: list[str], width: int) -> list[tuple[str, str]]:
    """Lines that end in the middle of a sentence although the next word had room."""
    found = []
    for before, after in zip(lines, lines[1:], strict=False):
        end, start = before.strip("│ "), after.strip("│ ")
        same = re.match(r"│? *", before)[0] == re.match(r"│? *", after)[0]
        if not (same and end and start) or start[0] in "-─•{" or end[-1] in ".)─╮╯" or before.startswith("usage"):
            continue
        if "," in end and " " not in end:  # names of commands, in a usage
            continue
        room = width - 2 * before.startswith("│") - len(before.rstrip("│ "))
        if len(start.split()[0]) + 1 <= room:
            found.append((before, after))
    return found


def test_a_help_breaks_no_sentence_where_the_source_does(monkeypatch, capsys):
    """tokenize said "run", broke the line, and went on with "`hma tokenizer train` first"."""
    monkeypatch.setenv("COLUMNS", "100")
    assert broken(["│ --a  hover: hold    │", "│      the tool       │", "│      it             │"], 24)
    wrong = {" ".join(c): broken(said_by(capsys, *c, "--help"), 100) for c in COMMANDS}
    assert not {name: lines for name, lines in wrong.items() if lines}


def test_lines_of_a_docstring_are_joined():
    doc = """Do it.

    First this,
    `then` that.

    Args:
        one: Of several
            lines. Default: as in
            (x).
        two: Short.
    """
    assert joined(doc) == (
        "Do it.\n\nFirst this, `then` that.\n\nArgs:\n    one: Of several lines. (default: as in (x))\n    two: Short."
    )
    assert joined(joined(doc)) == joined(doc)


def test_what_a_module_asks_costs_and_expects_are_paragraphs_of_its_help():
    doc = """Question: does it
    work?
    Command: python -m it
    Cost: a minute.

    It does: more words.
    """
    shown = "Question: does it work?\n\nCommand: python -m it\n\nCost: a minute.\n\nIt does: more words."
    assert joined(doc) == joined(shown) == shown


def test_choices_of_a_usage_are_broken_between_names():
    assert wrapped("usage: hma {one,two,three,four}\n", 20) == "usage: hma {one,\n       two,three,\n       four}\n"


def test_colours_of_a_terminal_count_for_nothing():
    """Lines of a box were broken in the middle on a terminal, as their codes made them look wider than it."""
    box = "\x1b[37;2m│\x1b[0m \x1b[1m--out\x1b[0m  here \x1b[37;2m│\x1b[0m"
    narrow = "\x1b[2ma\x1b[0m \x1b[2mb\x1b[0m"
    assert wrapped(f"{box}\n{narrow}\n", 12) == f"{box}\n{narrow}\n"
    assert wrapped("\x1b[1musage:\x1b[0m hma [-h] {a,b} RUN\n", 16) == "usage: hma [-h]\n       {a,b}\n       RUN\n"


@pytest.mark.parametrize("columns", [80, 120])
def test_a_mistyped_option_is_answered_by_its_own_command(columns, monkeypatch, capsys):
    """Before, by a screen of options of other commands, and with the help of all of them."""
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = said_by(capsys, "tokenize", "--preset", "smoke", "--steps", "3")
    text = "\n".join(lines)
    assert "--steps" in text and "hma tokenize --help" in text
    assert len(lines) < 12 and "hma convert" not in text and max(map(len, lines)) <= columns
    assert "--registry FILE" in "\n".join(said_by(capsys, "data", "inspect", "x", "--registri", "y"))


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (
            "train --set train.steps=10 train.batch=8 tau=1 --dry-run",
            "--set train.steps=10 --set train.batch=8 --set tau=1",
        ),
        ("sweep --set train.steps=10 train.batch=8 width", "--set train.steps=10 --set train.batch=8"),
        ("train --set train.steps 10", "--set train.steps=10"),
        ("study --launcher-set gpus=8 cpus=64", "--launcher-set gpus=8 --launcher-set cpus=64"),
        ("sweep width --set tau=1 wide", None),
        ("evaluate --set model.help runs/x --stepz 3", None),
        ("train --preset cpu --out DIR more=1", None),
    ],
)
def test_a_setting_that_is_not_preceded_by_its_option_is_told_how(typed, meant, capsys):
    last = said_by(capsys, *typed.split())[-1]
    if meant is None:
        assert "takes one" not in last
    else:
        option = meant.split()[0]
        assert last == f"error: {option} takes one setting and is repeated for others: {meant}"
