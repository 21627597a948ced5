"""Files that are never seen half written, nor lost with the power once they are seen."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def sync(path: Path) -> None:
    """What was written to a file, or renamed within a directory, survives a loss of power."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """An error of the system that names no file, as that of a full disk, names `path`."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.strerror:
            error.filename = str(path)
        raise


def write_file(path: Path, data: bytes | str) -> None:
    """A reader sees the old content or the new one, also after a crash. Raises OSError; the old content stays then."""
    content = data.encode() if isinstance(data, str) else data
    making = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with naming(path), open(making, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(making, path)
    finally:
        making.unlink(missing_ok=True)
    sync(path.parent)
