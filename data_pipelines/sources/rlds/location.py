"""Where files of datasets lie: on a disk, or in any store that fsspec knows.

Owns the difference between the two, which nothing else sees: a location has the methods of
`pathlib.Path` either way, and any of its bytes can be read without the others. Remote ones
(gs://, s3://, hf://, memory://, ...) are `upath.UPath` objects, of the extra `remote`.
"""

from __future__ import annotations

import functools
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from data_pipelines.errors import DataError, UnreachableError
from hma_jax.config import ConfigError

if TYPE_CHECKING:
    from upath import UPath

    Location = Path | UPath

REMOTE_READS = 16
"""Requests to a remote store at a time where many places are looked up."""

OPEN_FILES = 128
"""Files that `OpenFiles` holds by default: half of what the strictest system allows a process."""


class Ranges(Protocol):
    """An open file of `size` bytes."""

    @property
    def size(self) -> int: ...

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset` on; fewer at the end of the file.

        Raises OSError where a disk fails, UnreachableError where a remote store does.
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
            raise _missing(location) from None
        yield file
        return
    fd = _descriptor(location)
    try:
        yield DiskFile(fd)
    finally:
        os.close(fd)


class OpenFiles:
    """Files of a disk that stay open between reads: the `limit` read last.

    To open one costs as much as to read a frame, on a network drive far more. A file that gives
    way to another is closed when the last thread has read from it. Pickles as an empty one.
    """

    def __init__(self, limit: int = OPEN_FILES):
        self._limit = limit
        self._open = functools.lru_cache(limit)(_held)

    def __reduce__(self):
        return type(self), (self._limit,)

    def get(self, path: Path) -> DiskFile:
        """The file at `path` as it was when it was opened. Raises DataError as `open_ranges` does."""
        return self._open(path)


class DiskFile:
    """An open file descriptor as ranges."""

    def __init__(self, fd: int):
        self._fd = fd

    @property
    def size(self) -> int:
        return os.fstat(self._fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        return os.pread(self._fd, length, offset)


def _held(path: Path) -> DiskFile:
    """An open file that is closed when nobody refers to it any more."""
    fd = _descriptor(path)
    file = DiskFile(fd)
    weakref.finalize(file, os.close, fd).atexit = False  # threads may still read while a process ends
    return file


def _descriptor(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        raise _missing(path) from None
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}.") from error


def _missing(location: Location) -> DataError:
    return DataError(f"{location}: the shard is missing. Fetch it again, or check the path.")


class _RemoteFile:
    """One request per read."""

    def __init__(self, location: UPath):
        self._location = location
        self.size = int(self._ask(lambda: location.fs.size(location.path)))

    def read(self, offset: int, length: int) -> bytes:
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        place = self._location
        return self._ask(lambda: place.fs.cat_file(place.path, offset, end))

    def _ask(self, request):
        """A store out of reach is no damage of the data: the job stops, and goes on when repeated."""
        try:
            return request()
        except FileNotFoundError:
            raise
        except Exception as error:  # every protocol has exceptions of its own
            raise UnreachableError(
                f"{self._location}: cannot be read ({type(error).__name__}: {error}). "
                "Check the connection and the right to read, and run the same command again."
            ) from error
