"""The index of a split: offsets, lengths and checksums of all records, computed once and cached in a file.

Owns that file. It is in a cache directory, since datasets may be read-only: `$HMA_CACHE_DIR/index`, by default
`~/.cache/hma-jax/index`. It is valid for the shards' names, sizes and modification times (for remote ones ETags or
another version stamp), so a start lists the directory and reads no shard; only shards that changed are scanned again.

On each host, one process makes the index while the others wait for it.
"""

from __future__ import annotations

import fcntl
import hashlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.columns import Columns, write_columns
from data_pipelines.errors import CorruptRecordError, DataError, UnreachableError
from data_pipelines.sources.rlds.listing import list_files
from data_pipelines.sources.rlds.location import is_remote
from data_pipelines.sources.rlds.tfrecord import ShardIndex, scan_shard
from hma_jax.runtime.files import CACHE_VARIABLE, cache_directory

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

SCANS, REMOTE_SCANS = 16, 64
"""Shards that are scanned concurrently: most of the time is spent waiting for the disk or the store."""

SAVE_EVERY = 60.0
"""Seconds of scanning after which the index so far is saved, in case the process is killed."""

MIN_AGE = 2.0
"""A shard's modification time is trusted only if this many seconds passed between it and the scan: a change right after
the scan could have the same time."""

COLUMNS = {"offsets": np.int64, "lengths": np.int64, "checksums": np.uint32}

Scan = Callable[["Location"], tuple[ShardIndex, CorruptRecordError | None]]


@dataclass(frozen=True)
class Shard:
    """The index entry of one shard. `digest` is over the lengths and checksums of its records."""

    name: str
    size: int  # bytes
    stamp: str  # version of the file; "": unknown, so it is scanned at every start
    records: int
    digest: str
    missing: bool = False
    damage_at: int = -1  # byte at which the scan stopped; -1: at the file's end
    damage: str = ""


class RecordIndex:
    """`offsets`, `lengths` and `checksums` of the records of several shards, concatenated.

    `ends` int64 [shards]: the number of records up to and including each shard.
    """

    def __init__(self, shards: Sequence[Shard], columns: Mapping[str, np.ndarray] | Columns):
        self.shards = tuple(shards)
        self.ends = np.cumsum([s.records for s in self.shards], dtype=np.int64)
        self._columns = columns

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    @property
    def offsets(self) -> np.ndarray:
        """int64 [records]: first byte of a record's header."""
        return self._columns["offsets"]

    @property
    def lengths(self) -> np.ndarray:
        """int64 [records]: bytes of the payload."""
        return self._columns["lengths"]

    @property
    def checksums(self) -> np.ndarray:
        """uint32 [records]: of the payload, as stored."""
        return self._columns["checksums"]

    def locate(self, i: int) -> tuple[int, int]:
        """(shard, place in it) of record `i`."""
        shard = int(np.searchsorted(self.ends, i, side="right"))
        return shard, i - (int(self.ends[shard - 1]) if shard else 0)

    def rows(self, shard: int) -> slice:
        """The records of a shard."""
        end = int(self.ends[shard])
        return slice(end - self.shards[shard].records, end)


def load_index(directory: Location, split: str, shards: Sequence[Location], scan: Scan = scan_shard) -> RecordIndex:
    """The index of `shards`, all in `directory`, from its file or by scanning the shards that changed.

    Raises UnreachableError for a directory or shard that cannot be read (what was scanned is saved), DataError for
    shards whose names were swapped since they were indexed.
    """
    listing = list_files(directory)
    path = index_path(directory, split)
    known = read_index(path)
    if known is not None and _is_current(known, shards, listing):
        return known
    with exclusive_lock(path):
        known = read_index(path)  # another process may have made it in the meantime
        if known is not None and _is_current(known, shards, listing):
            return known
        return _make(path, shards, listing, known, scan)


def index_path(directory: Location, split: str) -> Path:
    """The cache file of a split's index."""
    text = str(directory) if is_remote(directory) else str(directory.absolute())
    return cache_directory() / "index" / f"{hashlib.sha256(f'{text}#{split}'.encode()).hexdigest()[:32]}.columns"


# --- making it -----------------------------------------------------------------------------------


def _make(
    path: Path,
    shards: Sequence[Location],
    listing: Mapping[str, tuple[int, str]],
    old: RecordIndex | None,
    scan: Scan,
) -> RecordIndex:
    began, old_rows = time.time(), {}
    if old is not None:
        old_rows = {s.name: (s, old.rows(n)) for n, s in enumerate(old.shards)}
    made: dict[str, tuple[Shard, dict[str, np.ndarray]]] = {}
    for shard in shards:
        size, stamp = listing.get(shard.name, (0, ""))
        before = old_rows.get(shard.name)
        if before is not None and stamp and (before[0].size, before[0].stamp) == (size, stamp):
            made[shard.name] = before[0], {c: getattr(old, c)[before[1]] for c in COLUMNS}
        elif shard.name not in listing:
            made[shard.name] = Shard(shard.name, 0, "", 0, "", missing=True), _no_rows()
    waiting = [shard for shard in shards if shard.name not in made]
    saved, failure = time.monotonic(), None
    for shard, found in _scan(waiting, scan):
        if isinstance(found, DataError):
            failure = failure or found
            continue
        size, stamp = listing[shard.name]
        made[shard.name] = _describe_shard(shard, size, _stamp_if_old(shard, stamp, began), *found)
        if time.monotonic() - saved > SAVE_EVERY:
            _write(path, shards, made)
            saved = time.monotonic()
    _check_not_swapped(
        {name: s for name, (s, _) in made.items()}, {n: s for n, (s, _) in old_rows.items()}, shards, path
    )
    index = _write(path, shards, made)
    if failure is not None:
        raise failure
    return index


def _scan(
    shards: Sequence[Location], scan: Scan
) -> Iterator[tuple[Location, tuple[ShardIndex, CorruptRecordError | None] | DataError]]:
    """Yields each shard with its index, or with the error of its scan; after an error no further scans are started."""
    failed = False

    def found(shard: Location):
        nonlocal failed
        if failed:
            return UnreachableError(f"{shard}: not scanned.")
        try:
            return scan(shard)
        except DataError as error:
            failed = True
            return error

    if not shards:
        return
    with ThreadPoolExecutor(REMOTE_SCANS if is_remote(shards[0]) else SCANS, "index") as pool:
        yield from zip(shards, pool.map(found, shards), strict=True)


def _describe_shard(
    shard: Location, size: int, stamp: str, index: ShardIndex, damage: CorruptRecordError | None
) -> tuple[Shard, dict[str, np.ndarray]]:
    rows = {name: getattr(index, name).astype(kind, copy=False) for name, kind in COLUMNS.items()}
    digest = hashlib.sha256(rows["lengths"].astype("<i8").tobytes() + rows["checksums"].astype("<u4").tobytes())
    stop = {} if damage is None else {"damage_at": damage.offset, "damage": damage.reason}
    return Shard(shard.name, size, stamp, len(index), digest.hexdigest()[:16], **stop), rows


def _stamp_if_old(shard: Location, stamp: str, began: float) -> str:
    """`stamp`, or "" for a file so new that a later change might not alter its stamp. A time far ahead comes from
    another clock, or from before this one was corrected."""
    return stamp if is_remote(shard) or abs(began - int(stamp) / 1e9) > MIN_AGE else ""


def _check_not_swapped(
    new: Mapping[str, Shard], old: Mapping[str, Shard], shards: Sequence[Location], path: Path
) -> None:
    """Raises DataError for two shards whose names were swapped: their episodes' names would be swapped too."""
    before = {s.digest: s.name for s in old.values() if s.records}
    for shard in shards:
        now = new.get(shard.name)
        was = before.get(now.digest, shard.name) if now is not None and now.records else shard.name
        other = new.get(was)
        if was == shard.name or other is None or shard.name not in old or now.digest == old[shard.name].digest:
            continue
        if other.digest == old[shard.name].digest:
            raise DataError(
                f"{shard} and {was}: these two shards have swapped names since they were indexed, so their episodes "
                f"have swapped names too. Rename them back; if the new names are correct, remove {path}."
            )


# --- its file --------------------------------------------------------------------------------------


def read_index(path: Path) -> RecordIndex | None:
    """The cached index; None if there is none, or it is damaged."""
    try:
        columns = Columns(path)
        shards = [Shard(**values) for values in columns.facts["shards"]]
        index = RecordIndex(shards, columns)
        whole = all(len(columns[name]) == len(index) for name in COLUMNS)
    except (OSError, DataError, KeyError, TypeError):
        return None  # it is made again from the shards
    return index if whole else None


def _write(
    path: Path, shards: Sequence[Location], made: Mapping[str, tuple[Shard, Mapping[str, np.ndarray]]]
) -> RecordIndex:
    known = [made[shard.name] for shard in shards if shard.name in made]
    columns = {
        name: np.concatenate([rows[name] for _, rows in known] or [np.zeros(0, kind)]) for name, kind in COLUMNS.items()
    }
    index = RecordIndex([shard for shard, _ in known], columns)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_columns(path, {"shards": [asdict(s) for s in index.shards]}, columns)
    except OSError as error:
        warnings.warn(
            f"{path}: the index of the shards cannot be written there ({error.strerror or error}), so every start "
            f"scans the shards again. Set {CACHE_VARIABLE} to a directory where you may write.",
            stacklevel=2,
        )
        return index
    return read_index(path) or index  # memory-mapped, so that it takes no memory of this process


def _is_current(index: RecordIndex, shards: Sequence[Location], listing: Mapping[str, tuple[int, str]]) -> bool:
    if [s.name for s in index.shards] != [p.name for p in shards]:
        return False
    for shard in index.shards:
        if shard.name in listing:
            if shard.missing or not shard.stamp or (shard.size, shard.stamp) != listing[shard.name]:
                return False
        elif not shard.missing:
            return False
    return True


def _no_rows() -> dict[str, np.ndarray]:
    return {name: np.zeros(0, kind) for name, kind in COLUMNS.items()}


@contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """Held by one process of this host at a time; the others wait."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = open(path.with_name(f"{path.name}.lock"), "w")  # noqa: SIM115
    except OSError:
        yield  # nothing can be cached there, as `_write` warns
        return
    with lock:
        with suppress(OSError):  # a file system without locks: two make the same file
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
