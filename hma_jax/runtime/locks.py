"""Exclusive locks on files, which are released when their process ends, however it ends.

One primitive for everything that only one process may do: training in a run directory, working in a study's
directory, making one dataset or one part of it (`data_pipelines.publishing`).

What is guaranteed depends on how far the file system supports flock:

* A local disk, or a shared one that supports flock between hosts (NFS 4, NFS 3 with its lock service, Lustre mounted
  with the option flock): one holder at a time. A process that dies by SIGKILL or power loss holds nothing.
* A shared disk that supports flock only within a host (NFS with the options nolock or local_lock, Lustre with the
  option localflock): one holder on each host. With a *lease*, one holder on all hosts, except that two processes that
  ask at the same moment may both get it, and that the lock of a host that died is free only after EXPIRES seconds.
* A disk that does not support flock at all: a warning is logged; with a lease, it is as between hosts.

A lease is the lock file's modification time, which its holder renews. It is compared with the file system's own clock,
so the hosts' clocks need not agree; where a directory is read-only, it is compared with this host's clock. A holder
that was suspended for longer than EXPIRES may lose its lease to another host, and learns this from `Lock.lost`. So what
a lease protects must be harmless if it is done twice.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from hma_jax.config import ConfigError
from hma_jax.runtime.files import IO_ERRNOS, naming

RENEWED_EVERY = 30.0
"""Seconds between two renewals of a lease."""

EXPIRES = 300.0
"""Seconds without renewal after which another machine's lease has expired."""

TAKEN = (errno.EAGAIN, errno.EACCES)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Holder:
    """Who holds a lock, as its file says."""

    process: int
    host: str
    since: str
    machine: str = ""  # the kernel that keeps the locks (`machine`): the same for all containers of a host
    token: str = ""  # distinguishes this holding of the lock from all others
    locked: bool = True  # whether the file system supports the lock

    def __str__(self) -> str:
        return f"process {self.process} on {self.host}, since {self.since}"


class Held(ConfigError):
    """Another process holds the lock. `holder` is None if it has not written its name yet."""

    def __init__(self, message: str, holder: Holder | None = None):
        super().__init__(message)
        self.holder = holder

    @property
    def who(self) -> str:
        return str(self.holder or "another process")


@dataclass(frozen=True)
class Lock:
    """A lock that is held."""

    path: Path
    holder: Holder

    def lost(self) -> bool:
        """Whether another process holds the lock by now, or its file is gone: possible only with a lease, or if files
        are removed.

        A lock file that cannot be read at the moment, as on a shared disk that does not answer, counts as held.
        """
        try:
            return read_holder(self.path) != self.holder
        except OSError:
            return False


@contextmanager
def exclusive(path: Path, *, lease: bool = False, remove: bool = False) -> Iterator[Lock]:
    """Holds the lock file `path`, which is created if it is missing.

    `lease`: also holds it against other machines where the file system does not (see above). `remove`: deletes the file
    when the lock is released. Raises Held at once if another process, or another thread, holds it, and OSError if the
    file cannot be read, written and locked at the moment.
    """
    fd, locked = _open(path, lease)
    try:
        if not locked and not lease:
            log.warning(
                "the file system of %s supports no locks; make sure that no other process uses it at the same time",
                path,
            )
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        lock = Lock(path, Holder(os.getpid(), socket.gethostname(), since, machine(), secrets.token_hex(8), locked))
        os.ftruncate(fd, 0)
        os.pwrite(fd, json.dumps(asdict(lock.holder)).encode(), 0)
        if lease:
            os.fsync(fd)  # other hosts see it
        try:
            with _renewed(fd) if lease else nullcontext():
                yield lock
        finally:
            with suppress(OSError):  # a disk that does not answer: what is left in the file ends with the lock or lease
                if read_holder(path) == lock.holder:
                    if remove:
                        path.unlink(missing_ok=True)
                    else:
                        os.ftruncate(fd, 0)
    finally:
        os.close(fd)


@cache
def machine() -> str:
    """The name of the running kernel, which keeps this process's locks; it changes with every boot."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:  # not Linux
        return socket.gethostname()


def _open(path: Path, lease: bool) -> tuple[int, bool]:
    """The open and locked file, and whether the file system supports the lock. Raises Held, OSError."""
    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            locked = _lock(fd, path, lease)
            # Whoever held it may have removed the file after it was opened here.
            if _same_file(fd, path):
                kept, fd = fd, -1
                return kept, locked
        finally:
            if fd >= 0:
                os.close(fd)


def find_held(path: Path) -> Held | None:
    """Returns (does not raise) the error that names the running process which holds the lease `path`; None if no
    process holds it. Nothing is written to the lock file. Raises OSError if it cannot be read at the moment."""
    try:
        while True:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                _lock(fd, path, lease=True, kind=fcntl.LOCK_SH)  # all that NFS allows for a file opened for reading
                if _same_file(fd, path):  # as in `_open`
                    return None
            finally:
                os.close(fd)
    except Held as held:
        return held
    except FileNotFoundError:
        return None


def _lock(fd: int, path: Path, lease: bool, kind: int = fcntl.LOCK_EX) -> bool:
    """Locks the open file. Returns whether the file system supports the lock. Raises Held, OSError."""
    with naming(path):
        locked = _flock(fd, kind)
    if locked is None or lease:
        holder = read_holder(path)
        if locked is None or _leased(path, holder, locked):
            raise Held(f"{path} is held by {holder or 'another process'}; wait for it or stop it", holder)
    return locked


def _flock(fd: int, kind: int) -> bool | None:
    """True: locked; None: another process holds it; False: the file system supports no locks. Raises OSError if it
    fails."""
    try:
        fcntl.flock(fd, kind | fcntl.LOCK_NB)
        return True
    except OSError as error:
        if error.errno in TAKEN:
            return None
        if error.errno in IO_ERRNOS:  # unknown whether another process holds it
            raise
        return False


def _leased(path: Path, holder: Holder | None, locked: bool) -> bool:
    """Whether the lock, which this kernel granted, is leased by another machine, whose locks it may not know of."""
    if holder is None or (locked and holder.locked and holder.machine == machine()):
        return False
    try:
        # In both directions: a time far ahead comes from a clock that was corrected since, and the lease was not
        # renewed after that.
        return abs(_now(path) - path.stat().st_mtime) < EXPIRES
    except FileNotFoundError:  # released in the meantime, or the directory was removed
        return False


def _now(path: Path) -> float:
    """The file system's time, read from a new file beside `path`; where none can be created, this host's time."""
    now = path.with_name(f"{path.name}.{secrets.token_hex(4)}.now")
    try:
        now.touch(exist_ok=False)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        return time.time()
    try:
        return now.stat().st_mtime
    finally:
        now.unlink(missing_ok=True)


def _same_file(fd: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(fd), os.stat(path))
    except FileNotFoundError:
        return False


def read_holder(path: Path) -> Holder | None:
    """The holder that the lock file names; None if the file is gone, the lock was released, or its holder has not
    written its name yet. Raises OSError if the file cannot be read."""
    try:
        return Holder(**json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError, ValueError, TypeError):
        return None


@contextmanager
def _renewed(fd: int) -> Iterator[None]:
    """Renews the lease while the block runs."""
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(RENEWED_EVERY):
            try:
                os.utime(fd)
            except OSError as error:  # a shared disk that does not answer for a while
                log.warning("a lock cannot be renewed (%s); trying again", error.strerror)

    thread = threading.Thread(target=renew, name="renew lock", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
