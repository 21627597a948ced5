"""Where files of datasets lie: on a disk, or in any store that fsspec knows.

Owns the difference between the two, which nothing else sees: a location has the methods of
`pathlib.Path` either way, and any of its bytes can be read without the others. Remote ones
(gs://, s3://, hf://, memory://, ...) are `upath.UPath` objects, of the extra `remote`.
"""

from __future__ import annotations

import os
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
    missing = f"{location}: the shard is missing. Fetch it again, or check the path."
    if is_remote(location):
        try:
            file = _RemoteFile(location)
        except FileNotFoundError:
            raise DataError(missing) from None
        yield file
        return
    try:
        fd = os.open(location, os.O_RDONLY)
    except FileNotFoundError:
        raise DataError(missing) from None
    except OSError as error:
        raise DataError(f"{location}: cannot be opened: {error.strerror}.") from error
    try:
        yield DiskFile(fd)
    finally:
        os.close(fd)


class DiskFile:
    """An open file descriptor as ranges."""

    def __init__(self, fd: int):
        self._fd = fd
        self.size = os.fstat(fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        return os.pread(self._fd, length, offset)


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
