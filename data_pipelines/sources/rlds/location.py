"""Where files of datasets lie: on a disk, or in any store that fsspec knows.

Owns the difference between the two, which nothing else sees: a location has the methods of
`pathlib.Path` either way, and any of its bytes can be read without the others. Remote ones
(gs://, s3://, hf://, memory://, ...) are `upath.UPath` objects, of the extra `remote`.
"""

from __future__ import annotations

import errno
import functools
import os
import random
import re
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeVar

from data_pipelines.errors import DataError, UnreachableError
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from upath import UPath

    Location = Path | UPath

T = TypeVar("T")

RETRY_WAITS = (0.1, 0.5, 2.0, 6.0)
"""Seconds before a read that failed is tried again, each time by up to half more or less."""

FAILURES = frozenset(
    getattr(errno, name)
    for name in (
        "EIO ESTALE ETIMEDOUT EREMOTEIO ENXIO ENODEV EAGAIN EBUSY EINTR EMFILE ENFILE ENOMEM ENETDOWN "
        "ENETUNREACH ECONNRESET ECONNABORTED ECONNREFUSED ENOTCONN EHOSTDOWN EHOSTUNREACH"
    ).split()
    if hasattr(errno, name)
)
"""What the system says of a disk, a network or itself, and never of what a file holds."""

LASTING = (PermissionError, IsADirectoryError, NotADirectoryError)
"""Failures that no waiting mends."""

MAX_OPEN_FILES = 128
"""Files that `OpenFiles` keeps open by default: half of the smallest usual limit of open files per process."""


class Ranges(Protocol):
    """An open file of `size` bytes."""

    @property
    def size(self) -> int: ...

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset` on; fewer at the end of the file.

        Raises UnreachableError where the disk or the store fails again and again.
        """
        ...


def locate(text: str | Path | UPath) -> Location:
    """The location of a path or URL. Raises ConfigError if it is remote and cannot be opened so."""
    if not isinstance(text, str):
        return text
    if not is_remote(text):
        return Path(text)
    try:
        from upath import UPath

        location = UPath(text)
        location.fs  # noqa: B018  imports what the protocol needs
    except ImportError as error:
        raise ConfigError(
            f"{text}: cannot be opened ({error}). Remote locations need the extra 'remote': "
            "pip install 'hma-jax[remote]', or copy the dataset to a disk."
        ) from error
    except ValueError as error:
        message = f"{text}: no location that fsspec knows ({error}). Correct its protocol."
        raise ConfigError(message) from error
    return location


def is_remote(location: str | Path | UPath) -> bool:
    """Whether it names a store and not a place on a disk."""
    return "://" in str(location) and not isinstance(location, Path)


def absolute(text: str) -> str:
    """The text of a location that means the same from any working directory."""
    return text if is_remote(text) else str(Path(text).absolute())


@contextmanager
def open_ranges(location: Location) -> Iterator[Ranges]:
    """The shard at `location`. Raises DataError if it is missing or cannot be opened."""
    if is_remote(location):
        try:
            file = _RemoteFile(location)
        except FileNotFoundError:
            raise missing(location) from None
        yield file
        return
    file = DiskFile(location)
    try:
        yield file
    finally:
        file.close()


def read_head(location: Location, max_bytes: int) -> bytes:
    """The first bytes of a file, up to `max_bytes`.

    Raises FileNotFoundError if there is none, UnreachableError where the disk or the store fails.
    """
    if is_remote(location):
        return _RemoteFile(location).read(0, max_bytes)

    def read() -> bytes:
        with open(location, "rb") as file:
            return file.read(max_bytes)

    return retried(location, read)


class OpenFiles:
    """Files of a disk that stay open between reads: the `limit` read last.

    To open one costs as much as to read a frame, on a network drive far more. A file that gives
    way to another is closed when the last thread has read from it. Pickles as an empty one.
    """

    def __init__(self, limit: int = MAX_OPEN_FILES):
        self._limit = limit
        self._open = functools.lru_cache(limit)(DiskFile)

    def __reduce__(self):
        return type(self), (self._limit,)

    def get(self, path: Path) -> DiskFile:
        """The file at `path` as it was when it was opened. Raises DataError as `open_ranges` does."""
        return self._open(path)


class Descriptor:
    """An open file descriptor of somebody else as ranges."""

    def __init__(self, fd: int):
        self._fd = fd

    @property
    def size(self) -> int:
        return os.fstat(self._fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        return os.pread(self._fd, length, offset)


class DiskFile(Descriptor):
    """A file of a disk, closed by `close` or when nobody refers to it any more.

    A read that fails opens the file again and is tried again: that is how a network disk comes back
    (ESTALE). Raises DataError if the file is missing or was replaced since it was opened.
    """

    def __init__(self, path: Path):
        try:
            super().__init__(retried(path, lambda: os.open(path, os.O_RDONLY)))
        except FileNotFoundError:
            raise missing(path) from None
        self._path, self._stamp = path, _stamp(self._fd)
        self._finalizer = weakref.finalize(self, os.close, self._fd)
        self._finalizer.atexit = False  # threads may still read while a process ends

    def close(self) -> None:
        self._finalizer()

    def read(self, offset: int, length: int) -> bytes:
        try:
            return os.pread(self._fd, length, offset)
        except OSError:
            pass
        try:
            return retried(self._path, lambda: self._read_anew(offset, length))
        except FileNotFoundError:
            raise missing(self._path) from None

    def _read_anew(self, offset: int, length: int) -> bytes:
        fd = os.open(self._path, os.O_RDONLY)
        try:
            if _stamp(fd) != self._stamp:
                message = f"{self._path}: the file was replaced while it was read. Run the same command again."
                raise DataError(message)
            data = os.pread(fd, length, offset)
            os.dup2(fd, self._fd, inheritable=False)  # for all threads, which know the descriptor by its number
            return data
        finally:
            os.close(fd)


def _stamp(fd: int) -> tuple[int, int]:
    status = os.fstat(fd)
    return status.st_size, status.st_mtime_ns


def retried(location: Location, request: Callable[[], T]) -> T:
    """The answer of `request`, asked again after each of RETRY_WAITS where a disk or a store fails.

    A failed read is no damage of data: after the last try the job stops, and goes on when it is
    repeated. Raises UnreachableError, naming `location`; FileNotFoundError and DataError at once.
    """
    for wait in (*RETRY_WAITS, None):
        try:
            return request()
        except (FileNotFoundError, DataError):
            raise
        except Exception as error:  # every protocol of a remote store has exceptions of its own
            if wait is None or isinstance(error, LASTING):
                raise UnreachableError(
                    f"{location}: cannot be read ({type(error).__name__}: {error}). Check the disk or the "
                    "connection and the right to read, and run the same command again."
                ) from error
            time.sleep(wait * random.uniform(0.5, 1.5))
    raise AssertionError("unreachable")


def exists(location: Location, kind: Literal["file", "directory"]) -> bool:
    """Whether a file or a directory is there. Raises UnreachableError where nobody can tell."""
    found = retried(location, location.is_dir if kind == "directory" else location.is_file)
    if found or not is_remote(location):
        return found
    try:  # a store that fails says No to the question above
        return retried(location, lambda: location.fs.info(location.path))["type"] == kind
    except FileNotFoundError:
        return False


def is_failure(error: Exception) -> bool:
    """Whether a library's error says that a file cannot be read, and nothing of its bytes."""
    told = re.search(r"errno\s*[=:]?\s*(\d+)", str(error), re.IGNORECASE)  # HDF5 has it in its words only
    number = getattr(error, "errno", None) or (int(told[1]) if told else 0)
    return isinstance(error, PermissionError) or number in FAILURES


def missing(location: Location) -> DataError:
    """What a shard that is not there is told as."""
    return DataError(f"{location}: the shard is missing. Fetch it again, or check the path.")


class _RemoteFile:
    """One request per read."""

    def __init__(self, location: UPath):
        self._location = location
        self.size = int(retried(location, lambda: location.fs.size(location.path)))

    def read(self, offset: int, length: int) -> bytes:
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        place = self._location
        try:
            return retried(place, lambda: place.fs.cat_file(place.path, start=offset, end=end))
        except FileNotFoundError:
            raise missing(place) from None
