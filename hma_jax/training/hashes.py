"""A list of a checkpoint's files with their hashes, with which damage is detected when they are read.

The list is in the checkpoint's own directory, so it is moved and deleted with it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from hma_jax.runtime.files import hash_file, write_file

NAME = "sha256.json"

THREADS = 8
"""The most files that are hashed at once: one core computes SHA-256 more slowly than most disks read."""

T = TypeVar("T")
Row = list[Any]
"""The list's entry for a file: path within the checkpoint, size in bytes, SHA-256."""

Chosen = Callable[[str], bool]
"""A file's path within the checkpoint -> whether the file is chosen."""


class Damaged(Exception):
    """A file is not as it was written. `path` names it, `reason` says how it differs."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason


class ReadError(OSError):
    """A file cannot be read at the moment: a shared disk does not answer, or too many files are open. It may be
    undamaged."""

    @classmethod
    def of(cls, path: Path, reason: str) -> ReadError:
        return cls(
            f"{path} cannot be read now ({reason}), so it is not known whether it is damaged. Run the same command again "
            "when its disk answers; if it never does, remove the checkpoint to continue from an earlier one"
        )


def hash_files(checkpoint: Path, chosen: Chosen) -> list[Row]:
    """A row for each of the `chosen` files under `checkpoint`."""
    files = [(name, path) for name, path in _files(checkpoint) if chosen(name)]
    return _in_threads(lambda file: [file[0], file[1].stat().st_size, hash_file(file[1])], files)


def write_list(checkpoint: Path, known: Iterable[Row] = ()) -> None:
    """Writes the list of every file under `checkpoint`; files in the rows that are `known` are not hashed again."""
    rows = {row[0]: row for row in known}
    rows |= {row[0]: row for row in hash_files(checkpoint, lambda name: name not in rows)}
    files = [rows[name] for name in sorted(rows)]
    write_file(checkpoint / NAME, json.dumps({"sha256": _hash_of(files), "files": files}, indent=0))


def read_list(checkpoint: Path) -> str:
    """The text of the list, which differs between checkpoints with different contents; '' if there is none."""
    path = checkpoint / NAME
    return path.read_text() if path.exists() else ""


def verify(checkpoint: Path, chosen: Chosen = lambda name: True, share: tuple[int, int] = (0, 1)) -> None:
    """Compares the `chosen` files with the list. A checkpoint that training has removed in the meantime is not an error
    here.

    With `share` (i, n) process i of n compares every n-th file, so that each file is read by one process. Raises
    Damaged for the first file that is missing or differs, the list itself included, and ReadError for one that cannot
    be read.
    """
    path = checkpoint / NAME
    try:
        text = path.read_text()
    except FileNotFoundError as error:
        if not checkpoint.is_dir():
            return
        raise Damaged(path, "is missing, so the checkpoint was not copied to its end") from error
    except OSError as error:
        raise ReadError.of(path, error.strerror) from error
    except ValueError as error:
        raise Damaged(path, f"cannot be read ({error})") from error
    rows = [row for row in _rows(path, text) if chosen(row[0])]
    _in_threads(lambda row: _compare(checkpoint / row[0], *row[1:]), rows[share[0] :: share[1]])


def _rows(path: Path, text: str) -> list[Row]:
    try:
        content: Any = json.loads(text)
        rows, stated = content["files"], content["sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise Damaged(path, f"is not a list of files ({error})") from error
    if _hash_of(rows) != stated:
        raise Damaged(path, "its contents do not match the hash in it")
    return rows


def _compare(path: Path, size: int, digest: str) -> None:
    try:
        found = path.stat().st_size
        if found != size:
            raise Damaged(path, f"has {found} bytes, but {size} were written")
        if hash_file(path) != digest:
            raise Damaged(path, "its contents have changed since it was written (SHA-256 differs)")
    except (FileNotFoundError, NotADirectoryError) as error:
        raise Damaged(path, f"cannot be read ({error.strerror})") from error
    except OSError as error:
        raise ReadError.of(path, error.strerror) from error


def _files(checkpoint: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(checkpoint.rglob("*")):
        name = path.relative_to(checkpoint).as_posix()
        if path.is_file() and name != NAME:
            yield name, path


def _in_threads(function: Callable[[Any], T], items: Iterable[Any]) -> list[T]:
    """`map` in threads. Raises the exception of the first item that raises one."""
    with ThreadPoolExecutor(THREADS, "hash") as threads:
        return list(threads.map(function, items))


def _hash_of(rows: Any) -> str:
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()
