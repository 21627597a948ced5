"""Files of outcomes: JSON while they are being made, and tables (CSV) of all of them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hma_jax.runtime.files import read_json, write_file


def make_once(path: Path, make: Callable[..., Any], *args: Any) -> Any:
    """The content of a JSON file; if it does not exist yet, `make(*args)` is written into it."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(make(*args)))
    return read_json(path, "remove it to have it made again")


def write_table(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Replaces the file, completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    write_file(path, text.getvalue())


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Writes rows with the names of the first one; floats have four decimals."""
    names = list(rows[0])
    cells = [[f"{v:.4f}" if isinstance(v := row[name], float) else v for name in names] for row in rows]
    write_table(path, names, cells)
