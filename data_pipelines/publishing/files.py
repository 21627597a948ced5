"""Publishing of directories: readers never see one half written, and a published one survives a power failure."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path

from hma_jax.runtime.files import sync, sync_tree


def publish(made: Path, final: Path) -> None:
    """Moves the finished directory `made` to `final`, on the same disk, and removes what was there.

    The caller holds the lock of `final`. Raises OSError.
    """
    sync_tree(made)
    remove(final)
    os.rename(made, final)
    sync(final.parent)


def remove(directory: Path) -> None:
    """Removes a directory, if it exists: renames it first, so that no reader sees it half removed."""
    prefix = f".{directory.name.lstrip('.')}.removed"
    if directory.exists():
        # A name of its own: NFS keeps the directory of files that are open elsewhere.
        os.rename(directory, directory.with_name(f"{prefix}.{secrets.token_hex(4)}"))
    for gone in directory.parent.glob(f"{prefix}*"):  # also those of processes that died here
        shutil.rmtree(gone, ignore_errors=True)
