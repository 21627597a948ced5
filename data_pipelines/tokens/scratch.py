"""A directory for files that are not finished, removed when its process ends or has died.

Owns nothing but that. It lies beside what it is for, on the same disk, so that a finished
file gets to its place by a rename.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def scratch(root: Path) -> Iterator[Path]:
    """An empty directory of this process under `root`; those of dead processes are removed.

    Whether a process lives is known by a lock that dies with it, and asked for processes of
    this machine only: not every file system carries locks to other ones.
    """
    root.mkdir(parents=True, exist_ok=True)
    _remove_dead(root)
    name = f"{socket.gethostname()}.{os.getpid()}.{secrets.token_hex(4)}"
    waiting, lock, directory = root / f".new.{name}", root / f"{name}.lock", root / name
    with open(waiting, "w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        os.rename(waiting, lock)  # nobody ever sees it unlocked
        directory.mkdir()
        try:
            yield directory
        finally:
            shutil.rmtree(directory, ignore_errors=True)
            lock.unlink(missing_ok=True)


def _remove_dead(root: Path) -> None:
    for lock in root.glob(f"{socket.gethostname()}.*.lock"):
        try:
            with open(lock) as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
                lock.unlink(missing_ok=True)
        except (BlockingIOError, FileNotFoundError):
            pass  # alive, or gone meanwhile
