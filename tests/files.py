"""What a program has written, to compare two of its runs."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path


def contents(root: Path, leaving_out: Collection[str] = ()) -> dict[str, bytes]:
    """The bytes of every file below `root`, by its path, except those whose names are in `leaving_out`."""
    files = (p for p in root.rglob("*") if p.is_file() and p.name not in leaving_out)
    return {str(p.relative_to(root)): p.read_bytes() for p in files}
