"""Reads JSON files of unknown origin: an object, or a DataError that names the file and says what to do.

Owns the limits: parsing takes many times the memory of the text, so the size of a file and the number of its
values are checked first.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.location import read_head

if TYPE_CHECKING:
    from upath import UPath

MAX_BYTES = 16 * 2**20
"""Bytes of a JSON file, or of a line of a JSON Lines file."""

MAX_VALUES = 400_000
"""Commas, colons and opening brackets in a JSON text; each costs at most 100 bytes of memory when it is parsed."""

STRUCTURE = (b",", b":", b"[", b"{")


def read_object(path: Path | UPath, *, if_missing: str, advice: str) -> dict[str, Any]:
    """The JSON object in `path`. Raises DataError, with `if_missing` if there is no such file, and with `advice` if it
    cannot be read."""
    try:
        text = read_head(path, MAX_BYTES + 1)
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {if_missing}") from None
    return _parse(text, path, advice)


def read_lines(path: Path, *, if_missing: str, advice: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """(line number, object) of each line of a JSON Lines file that is not blank."""
    try:
        with open(path, "rb") as file:
            number = 0
            while line := file.readline(MAX_BYTES + 1):
                number += 1
                if line.isspace():
                    continue
                yield number, _parse(line, f"{path}: line {number}", advice)
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {if_missing}") from None
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error}). {advice}") from error


def _parse(text: bytes, where: object, advice: str) -> dict[str, Any]:
    if len(text) > MAX_BYTES:
        raise DataError(f"{where} has more than {MAX_BYTES:,} bytes, too many for such a file. {advice}")
    if len(text) > MAX_VALUES and sum(map(text.count, STRUCTURE)) > MAX_VALUES:
        raise DataError(f"{where} has more than {MAX_VALUES:,} values, too many for such a file. {advice}")
    try:
        value = json.loads(text.decode("utf-8-sig"))
    except ValueError as error:
        raise DataError(f"{where} cannot be read ({error}). {advice}") from error
    except RecursionError:
        raise DataError(f"{where} cannot be read (it is nested too deeply). {advice}") from None
    if not isinstance(value, dict):
        raise DataError(f"{where} holds no JSON object. {advice}")
    return value
