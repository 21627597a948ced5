"""One process trains in a run directory at a time: a lock that dies with its process."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_jax.config import ConfigError

NAME = ".lock"
HELD = (errno.EAGAIN, errno.EACCES)

log = logging.getLogger(__name__)


class RunBusy(ConfigError):
    """Another process trains in the directory."""


@contextmanager
def claimed(run_dir: Path) -> Iterator[None]:
    """Makes `run_dir` and holds it. Raises RunBusy naming the process that holds it already, and
    ConfigError if it cannot be written."""
    path = run_dir / NAME
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+")
    except OSError as error:
        raise ConfigError(
            f"cannot write to the run directory {run_dir}: {error.strerror}; choose another output directory "
            "or fix its permissions"
        ) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in HELD:
                raise RunBusy(_message(run_dir, path)) from None
            log.warning("%s cannot be locked (%s); see that no other process trains there", path, error.strerror)
        file.truncate(0)
        holder = {"process": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        file.write(json.dumps(holder))
        file.flush()
        yield


def _message(run_dir: Path, path: Path) -> str:
    try:
        holder = json.loads(path.read_text())
        who = f"process {holder['process']} on {holder['host']}, since {holder['since']}"
    except (OSError, ValueError, KeyError, TypeError):  # it has the lock and has not written its name yet
        who = "another process"
    return (
        f"{run_dir} is being trained in by {who}; wait for it or stop it (Ctrl-C saves first), or choose "
        "another run directory"
    )
