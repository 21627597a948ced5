"""Entries in a file outside this project: a TOML table per dataset, fields as in `DatasetSpec`.

    [my_robot]
    image_key = "observation/image"
    action_keys = ["action[:7]"]
    action_dims = [7]
    hz = 10

`hma data inspect --entry FILE` writes one.
"""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from pathlib import Path

from data_pipelines.registry.spec import DatasetSpec
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict

_HEADING = re.compile(r"""\s*\[\s*(?:"([^"]*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*\]\s*(?:#.*)?""")


def load_entries(path: str | Path) -> tuple[DatasetSpec, ...]:
    """The entries of a file. Raises ConfigError, naming file and entry, for anything that is not an entry."""
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: the registry file cannot be read ({error.strerror})") from error
    except ValueError as error:  # TOMLDecodeError and UnicodeDecodeError are subclasses of it
        raise ConfigError(f"{path}: not a TOML file: {error}") from error
    except RecursionError:
        raise ConfigError(f"{path}: not a TOML file of registry entries: it is nested too deeply") from None
    entries = []
    for name, fields in tables.items():
        try:
            if not isinstance(fields, dict):
                raise ConfigError(
                    f"{name} = {fields!r} is not in a table; write it below a heading [NAME] with the dataset's name"
                )
            if "name" in fields:  # it would be the entry of a dataset other than the heading says
                raise ConfigError(f"{name}: remove name = {fields['name']!r}; the heading is the name of the entry")
            if isinstance(fields.get("image_key"), list):
                raise ConfigError(
                    f"{name}: image_key = {fields['image_key']!r} lists cameras, but a model has one; name one of them. "
                    "docs/own_data.md says what can be done with several"
                )
            entry = from_dict(DatasetSpec, {"name": name} | fields, name)
            if entry.angles and "angle_form" not in fields:  # by default they would be left as they are
                raise ConfigError(f'{name}: angles needs angle_form too; add angle_form = "sine_cosine" or "unwrapped"')
            entries.append(entry)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    return tuple(entries)


def to_toml(spec: DatasetSpec) -> str:
    """The table of one entry, without fields that have their default."""
    lines = [f"[{json.dumps(spec.name)}]"]
    for field in dataclasses.fields(DatasetSpec)[1:]:
        value = getattr(spec, field.name)
        if value != field.default:
            # JSON's strings, numbers, booleans and lists are TOML's too, but for its escapes of rare characters.
            lines.append(f"{field.name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def put_entry(text: str, spec: DatasetSpec, where: str) -> str:
    """`text`, a file of entries, with the entry of `spec` added at its end or in place of the entry of the same name.
    All else stays, including comments outside that entry. Raises ConfigError, naming `where`, if no place is found."""
    lines = [f"{line}\n" for line in text.splitlines()]
    headings = {i: m[1] or m[2] or m[3] for i, line in enumerate(lines) if (m := _HEADING.fullmatch(line.rstrip()))}
    begin = next((i for i, name in headings.items() if name == spec.name), len(lines))
    end = next((i for i in headings if i > begin), len(lines))
    while end > begin + 1 and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
        end -= 1  # a comment before the next heading belongs to that heading
    space = ["\n"] if begin == len(lines) > 0 else []
    put = "".join([*lines[:begin], *space, to_toml(spec), *lines[end:]])
    try:
        right = tomllib.loads(put) == tomllib.loads(text) | tomllib.loads(to_toml(spec))
    except tomllib.TOMLDecodeError:  # it is there in a form other than a table of its own
        right = False
    require(right, f"{where}: the entry of {spec.name} cannot be added to this file; write it to another file")
    return put
