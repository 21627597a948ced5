"""How a command ends: what it wrote and what comes next."""

from __future__ import annotations

from pathlib import Path

from rich.text import Text

from experiments.progress import console, say
from experiments.setting import short


def wrote(*paths: Path, then: str = "", about: str = "") -> None:
    """Says what was written, the whole command that comes `then`, and a remark `about` it all."""
    for path in paths:
        console.print("wrote", Text(short(path), "bold"), soft_wrap=True)
    if then:
        console.print(Text(f"next: {then}"), soft_wrap=True)
    if about:
        say(f"note: {about}")
