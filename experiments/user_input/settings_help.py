"""The table of `--set help`: every setting with its value and the comment on its field in the source."""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Literal, NamedTuple

from rich.markup import escape

from experiments.terminal.progress import console, tidy_table
from hma_jax.config.json import to_dict


class SettingHelp(NamedTuple):
    path: str
    value: str  # as --set takes it
    text: str


def show_settings(found: list[SettingHelp], title: str) -> None:
    table = tidy_table(title, "setting")
    table.add_column("value", overflow="fold")
    table.add_column("meaning", min_width=30)
    for one in found:
        table.add_row(one.path, escape(one.value), escape(one.text))
    console.print(table)


def describe_settings(config: Any, prefix: str = "") -> Iterator[SettingHelp]:
    """Help on every setting of a dataclass, whose fields are values or further such dataclasses, in order."""
    kinds, texts = typing.get_type_hints(type(config)), comments(type(config))
    for field in fields(config):
        path, value = prefix + field.name, getattr(config, field.name)
        if is_dataclass(value):
            yield from describe_settings(value, f"{path}.")
            continue
        text = texts.get(field.name, "")
        if typing.get_origin(kinds[field.name]) is Literal:
            text = f"{text} ({', '.join(typing.get_args(kinds[field.name]))})".strip()
        yield SettingHelp(path, _as_set(to_dict(value)), text)


def comments(config: type) -> dict[str, str]:
    """The first sentence of each field's comment, which is behind the field or in the lines above."""
    inherited = (comments(base) for base in config.__bases__ if is_dataclass(base))
    found = {name: text for base in inherited for name, text in base.items()}
    source = textwrap.dedent(inspect.getsource(config))
    lines = source.splitlines()
    (declared,) = ast.parse(source).body
    for node in declared.body:
        if not isinstance(node, ast.AnnAssign):
            continue
        end = lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode()
        parts, above = [end.partition("#")[2].strip()], node.lineno - 2
        while not parts[0] and lines[above].lstrip().startswith("#"):
            parts.insert(1, lines[above].lstrip(" #"))
            above -= 1
        found[node.target.id] = re.split(r"\.(?= [A-Z]|$)", " ".join(parts).strip())[0]
    return found


def _as_set(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_as_set, value)) or "[]"
    return value if isinstance(value, str) else json.dumps(value)
