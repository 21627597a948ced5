"""The files of a directory with their sizes and version stamps, without opening any.

Owns what identifies a file's version: the modification time on a disk, an ETag or similar in an object store.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from data_pipelines.sources.rlds.location import is_remote, retry

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

VERSION_FIELDS = ("ETag", "etag", "md5Hash", "crc32c", "blob_id", "generation", "version_id", "content_md5")
TIME_FIELDS = ("LastModified", "last_modified", "updated", "mtime", "modified", "created")


def list_files(directory: Location) -> dict[str, tuple[int, str]]:
    """(size, stamp) of every file of a directory, by name, without opening one."""
    if not is_remote(directory):
        return retry(directory, lambda: _list_directory(directory))
    fs = directory.fs
    fs.invalidate_cache(directory.path)
    found = retry(directory, lambda: fs.ls(directory.path, detail=True))
    files = [f for f in found if f["type"] == "file"]
    return {f["name"].rstrip("/").rsplit("/", 1)[-1]: (int(f["size"]), _stamp(f)) for f in files}


def _list_directory(directory: Path) -> dict[str, tuple[int, str]]:
    found = {}
    with os.scandir(directory) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):  # a temporary file of somebody
                if entry.is_file():
                    status = entry.stat()
                    found[entry.name] = status.st_size, str(status.st_mtime_ns)
    return found


def _stamp(facts: Mapping) -> str:
    for kind in (VERSION_FIELDS, TIME_FIELDS):
        for name in kind:
            if facts.get(name):
                return f"{name} {facts[name]}"
    return ""
