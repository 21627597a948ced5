"""What a program forces to the disk, and when: a loss of power cannot be had in a test."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def record_writes(root: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A list that grows with what is forced to the disk below `root`, by its name, and with "rename" where something
    is renamed."""
    done, fsync = [], os.fsync

    def recorded(fd: int) -> None:
        done.extend(path.name for path in (root, *root.rglob("*")) if os.path.samestat(path.stat(), os.fstat(fd)))
        fsync(fd)

    monkeypatch.setattr(os, "fsync", recorded)
    for name in ("rename", "replace"):
        move = getattr(os, name)
        monkeypatch.setattr(os, name, lambda a, b, move=move: (done.append("rename"), move(a, b)))
    return done
