"""Tables of README and docs/, for tests that hold their figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def table(page: Path, header: str) -> dict[str, list[str]]:
    """First cell -> the others, of the table that begins with `header`."""
    return rows_below(page.read_text().split(header, 1)[1].splitlines())


def rows_below(lines: Sequence[str]) -> dict[str, list[str]]:
    """First cell -> the others, of the table whose header is the first of the lines."""
    rows = {}
    for line in lines[2:]:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip().strip("|").split("|"))
        rows[first] = rest
    assert rows
    return rows
