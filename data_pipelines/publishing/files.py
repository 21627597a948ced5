"""Directories that are never seen half written, nor lost with the power once they are seen."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from hma_jax.runtime.files import sync


def sync_tree(directory: Path) -> None:
    """`sync` of everything below a directory, and of itself."""
    for root, _, files in os.walk(directory):
        for name in files:
            sync(Path(root, name))
        sync(Path(root))


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
