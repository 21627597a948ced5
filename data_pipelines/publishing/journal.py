"""Which steps of an output are finished: one line of JSON for each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hma_jax.runtime.files import append_line, write_file


class Journal:
    """A file that one process at a time appends to, under the output's lock. A written line survives a crash."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> list[dict[str, Any]]:
        """All lines. An incomplete last line, which a crash left, is removed."""
        if not self.path.exists():
            return []
        *whole, cut = self.path.read_bytes().split(b"\n")
        if cut:
            write_file(self.path, b"".join(line + b"\n" for line in whole))
        return [json.loads(line) for line in whole]

    def append(self, values: dict[str, Any]) -> None:
        append_line(self.path, json.dumps(values))
