"""What is finished of a thing that is made step by step: one line of JSON for every step."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


class Journal:
    """A file that one process at a time appends to, under a claim. A line that is there survives a crash."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> list[dict[str, Any]]:
        """All lines. One that a crash cut off is removed."""
        if not self.path.exists():
            return []
        *whole, cut = self.path.read_bytes().split(b"\n")
        if cut:
            self.path.write_bytes(b"".join(line + b"\n" for line in whole))
        return [json.loads(line) for line in whole]

    def append(self, values: dict[str, Any]) -> None:
        with open(self.path, "a") as file:
            file.write(json.dumps(values) + "\n")
            file.flush()
            os.fsync(file.fileno())
