"""Tables of README and docs/, for tests that hold their figures."""

from __future__ import annotations

from pathlib import Path


def table(page: Path, header: str) -> dict[str, list[str]]:
    """First cell -> the others, of the table that begins with `header`."""
    lines = page.read_text().split(header, 1)[1].splitlines()[2:]
    rows = {}
    for line in lines:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip().strip("|").split("|"))
        rows[first] = rest
    assert rows
    return rows
