"""Locations of dataset files: paths on a disk, or URLs of any object store that fsspec supports.

Owns the difference between the two, which no other module sees: either way a location has the methods of
`pathlib.Path`, and any range of its bytes can be read without the rest. Remote locations (gs://, s3://, memory://, ...)
are `upath.UPath` objects, of the extra `remote`.
"""

from __future__ import annotations

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
from hma_jax.runtime.files import IO_ERRNOS

if TYPE_CHECKING:
    from upath import UPath

    Location = Path | UPath

T = TypeVar("T")

RETRY_WAITS = (0.1, 0.5, 2.0, 6.0)
"""Seconds to wait before each retry of a failed read, with a random factor of 0.5 to 1.5."""

PERMANENT_ERRORS = (PermissionError, IsADirectoryError, NotADirectoryError)
"""Errors that retrying does not cure."""

MAX_OPEN_FILES = 128
"""Number of files that `OpenFiles` keeps open by default: half of the smallest usual limit of open files per
process."""


CHUNK = 4 * 2**20
"""Bytes of a file in memory at a time while `read_through` reads it."""


class RandomAccessFile(Protocol):
    """An open file of `size` bytes, any range of which can be read."""

    @property
    def size(self) -> int: ...

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset` on; fewer at the end of the file.

        Raises UnreachableError if the disk or the store still fails after all retries.
        """
        ...


def locate(text: str | Path | UPath) -> Location:
    """The location of a path or URL. Raises ConfigError if it is a URL that cannot be opened."""
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
            f"{text}: cannot be opened ({error}). gs:// and s3:// need the extra 'remote' (pip install 'hma-jax[remote]'), "
            "other protocols also the package that fsspec asks for. Or copy the dataset to a disk."
        ) from error
    except ValueError as error:
        message = f"{text}: fsspec does not know this kind of location ({error}). Correct its protocol."
        raise ConfigError(message) from error
    return location


def is_remote(location: str | Path | UPath) -> bool:
    """Whether it is a URL of an object store, not a path on a disk."""
    return "://" in str(location) and not isinstance(location, Path)


def absolute(text: str) -> str:
    """The location as text that does not depend on the working directory."""
    return text if is_remote(text) else str(Path(text).absolute())


@contextmanager
def open_random_access(location: Location) -> Iterator[RandomAccessFile]:
    """Opens the shard at `location`. Raises DataError if it is missing or cannot be opened."""
    if is_remote(location):
        try:
            file = _RemoteFile(location)
        except FileNotFoundError:
            raise missing_shard(location) from None
        yield file
        return
    file = DiskFile(location)
    try:
        yield file
    finally:
        file.close()


def read_head(location: Location, max_bytes: int) -> bytes:
    """The first bytes of a file, up to `max_bytes`.

    Raises FileNotFoundError if there is none, UnreachableError if the disk or the store fails.
    """
    if is_remote(location):
        return _RemoteFile(location).read(0, max_bytes)

    def read() -> bytes:
        with open(location, "rb") as file:
            return file.read(max_bytes)

    return retry(location, read)


def read_through(path: Path) -> None:
    """Reads a file to its end, to distinguish a failing disk from damaged contents.

    Raises FileNotFoundError if there is none, UnreachableError if the disk fails.
    """

    def read() -> None:
        with open(path, "rb", buffering=0) as file:
            while file.read(CHUNK):
                pass

    retry(path, read)


class OpenFiles:
    """An LRU cache of at most `limit` open files on a disk.

    Opening a file costs as much as reading a frame, on a network drive far more. An evicted file is closed when
    the last thread has read from it. Pickles as an empty cache.
    """

    def __init__(self, limit: int = MAX_OPEN_FILES):
        self._limit = limit
        self._open = functools.lru_cache(limit)(DiskFile)

    def __reduce__(self):
        return type(self), (self._limit,)

    def get(self, path: Path) -> DiskFile:
        """The file at `path` as it was when it was opened. Raises DataError as `open_random_access` does."""
        return self._open(path)


class Descriptor:
    """A file descriptor that somebody else opened and closes, as a `RandomAccessFile`."""

    def __init__(self, fd: int):
        self._fd = fd

    @property
    def size(self) -> int:
        return os.fstat(self._fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        return os.pread(self._fd, length, offset)


class DiskFile(Descriptor):
    """A file on a disk, closed by `close` or when it is garbage-collected.

    After a failed read the file is reopened and read again, which a network disk needs after ESTALE. Raises DataError
    if the file is missing or was replaced since it was opened.
    """

    def __init__(self, path: Path):
        try:
            super().__init__(retry(path, lambda: os.open(path, os.O_RDONLY)))
        except FileNotFoundError:
            raise missing_shard(path) from None
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
            return retry(self._path, lambda: self._reopen_and_read(offset, length))
        except FileNotFoundError:
            raise missing_shard(self._path) from None

    def _reopen_and_read(self, offset: int, length: int) -> bytes:
        fd = os.open(self._path, os.O_RDONLY)
        try:
            if _stamp(fd) != self._stamp:
                message = f"{self._path}: the file was replaced while it was being read. Run the same command again."
                raise DataError(message)
            data = os.pread(fd, length, offset)
            os.dup2(fd, self._fd, inheritable=False)  # for all threads, which use the descriptor by its number
            return data
        finally:
            os.close(fd)


def _stamp(fd: int) -> tuple[int, int]:
    status = os.fstat(fd)
    return status.st_size, status.st_mtime_ns


def retry(location: Location, request: Callable[[], T]) -> T:
    """The result of `request`, which is repeated after each of RETRY_WAITS while a disk or a store fails.

    A failed read does not mean damaged data: after the last retry the job stops, and the same command resumes it.
    Raises UnreachableError, naming `location`; FileNotFoundError and DataError at once.
    """
    for wait in (*RETRY_WAITS, None):
        try:
            return request()
        except (FileNotFoundError, DataError):
            raise
        except Exception as error:  # every protocol of a remote store has exceptions of its own
            if wait is None or isinstance(error, PERMANENT_ERRORS):
                raise UnreachableError(
                    f"{location}: cannot be read ({type(error).__name__}: {error}). Check the disk or the "
                    "connection and the right to read, and run the same command again."
                ) from error
            time.sleep(wait * random.uniform(0.5, 1.5))
    raise AssertionError("unreachable")


def exists(location: Location, kind: Literal["file", "directory"]) -> bool:
    """Whether `location` is an existing file or directory. Raises UnreachableError if that cannot be determined."""
    found = retry(location, location.is_dir if kind == "directory" else location.is_file)
    if found or not is_remote(location):
        return found
    try:  # is_dir and is_file of a remote store return False for errors too
        return retry(location, lambda: location.fs.info(location.path))["type"] == kind
    except FileNotFoundError:
        return False


def is_io_error(error: Exception) -> bool:
    """Whether a library's error came from reading the file, not from its contents."""
    match = re.search(r"errno\s*[=:]?\s*(\d+)", str(error), re.IGNORECASE)  # HDF5 gives it only in its message
    number = getattr(error, "errno", None) or (int(match[1]) if match else 0)
    return isinstance(error, PermissionError) or number in IO_ERRNOS


def missing_shard(location: Location) -> DataError:
    """The error for a shard that does not exist."""
    return DataError(f"{location}: the shard is missing. Download it again, or check the path.")


class _RemoteFile:
    """A file in an object store; every read is one request."""

    def __init__(self, location: UPath):
        self._location = location
        self.size = int(retry(location, lambda: location.fs.size(location.path)))

    def read(self, offset: int, length: int) -> bytes:
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        place = self._location
        try:
            return retry(place, lambda: place.fs.cat_file(place.path, start=offset, end=end))
        except FileNotFoundError:
            raise missing_shard(place) from None
