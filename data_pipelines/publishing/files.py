"""Files and directories that are never seen half written, nor lost with the power once they are seen."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path


def sync(path: Path) -> None:
    """What was written to a file, or renamed within a directory, survives a loss of power."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_tree(directory: Path) -> None:
    """`sync` of everything below a directory, and of itself."""
    for root, _, files in os.walk(directory):
        for name in files:
            sync(Path(root, name))
        sync(Path(root))


def write_file(path: Path, data: bytes | str) -> None:
    """A reader sees the old content or the new one, also after a crash."""
    content = data.encode() if isinstance(data, str) else data
    making = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(making, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(making, path)
    finally:
        making.unlink(missing_ok=True)
    sync(path.parent)


def publish(made: Path, final: Path) -> None:
    """Puts the finished directory `made` in the place of `final`, on the same disk.

    What was there is removed. The caller holds the claim of `final`. Raises OSError.
    """
    sync_tree(made)
    remove(final)
    os.rename(made, final)
    sync(final.parent)


def remove(directory: Path) -> None:
    """Removes a directory, if it is there: out of sight at once, then file by file."""
    gone = directory.with_name(f".{directory.name.lstrip('.')}.removed")
    shutil.rmtree(gone, ignore_errors=True)  # of a process that died here
    if directory.exists():
        os.rename(directory, gone)
        shutil.rmtree(gone, ignore_errors=True)
