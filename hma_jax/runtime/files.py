"""Atomic and durable writes: a file is never seen half written, and survives a loss of power once it is seen."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from hma_jax.config import ConfigError

IO_ERRNOS = frozenset(
    getattr(errno, name)
    for name in (
        "EIO ESTALE ETIMEDOUT EREMOTEIO ENXIO ENODEV EAGAIN EBUSY EINTR EMFILE ENFILE ENOMEM ENETDOWN "
        "ENETUNREACH ECONNRESET ECONNABORTED ECONNREFUSED ENOTCONN EHOSTDOWN EHOSTUNREACH"
    ).split()
    if hasattr(errno, name)
)
"""errno values that report a failing disk, network or operating system, and never damaged contents."""


CACHE_VARIABLE = "HMA_CACHE_DIR"


def cache_directory() -> Path:
    """The directory of what is kept for later processes of this user: `$HMA_CACHE_DIR`, by default `~/.cache/hma-jax`.
    Raises ConfigError for a user without a home directory, as in some containers."""
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen)
    try:
        return Path.home() / ".cache" / "hma-jax"
    except RuntimeError:
        raise ConfigError(
            f"this user has no home directory to keep files in; set {CACHE_VARIABLE} to a directory where you may write"
        ) from None


def hash_file(path: Path) -> str:
    """SHA-256 of a file's contents, in hex digits. The file is read in small parts: it may be larger than memory."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Flushes a file, or the renames within a directory, to disk (fsync)."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_tree(directory: Path) -> None:
    """`sync` of everything below a directory, and of itself."""
    for root, _, files in os.walk(directory):
        for name in files:
            sync(Path(root, name))
        sync(Path(root))


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Adds `path` to an OSError from the block that names no file, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.strerror:
            error.filename = str(path)
        raise


def write_file(path: Path | str, data: bytes | str) -> None:
    """Replaces the file: readers see either the old content or the new, even after a crash. Raises OSError, in which
    case the old content stays."""
    path = Path(path)
    content = data.encode() if isinstance(data, str) else data
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with naming(path), open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def read_json(path: Path, advice: str) -> Any:
    """The content of a JSON file. Raises ConfigError, with `advice`, for a damaged one, such as a copy that was cut
    off; OSError if it is missing or cannot be read now."""
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ConfigError(f"{path} is damaged ({error}); {advice}") from error


def append_line(path: Path, line: str) -> None:
    """Adds a line to a text file, which is made if it is missing, and waits until it is on disk. A torn last line,
    which a crash or a full disk left, is removed. One process at a time. Raises OSError."""
    with naming(path), open(path, "ab+") as file:
        _cut_torn_line(file)
        file.write(line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def _cut_torn_line(file: BinaryIO) -> None:
    """Removes what follows the last newline."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 65536, 0))
    tail = file.read()
    if tail and not tail.endswith(b"\n"):
        file.truncate(size - (len(tail) - (tail.rfind(b"\n") + 1)))
    file.seek(0, os.SEEK_END)
