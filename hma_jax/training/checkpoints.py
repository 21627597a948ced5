"""Checkpoints: whole or absent, on any mesh, and never mistaken for another run's.

Orbax (v1) writes asynchronously. Then its files are flushed to disk and listed with hashes, and only then does the
checkpoint get its name, DIRECTORY/<step>. So a directory with such a name is complete, and readers check the hashes.
Earlier checkpoints are removed after that. A save that was interrupted earlier leaves a directory with another name
(LEFTOVER), which the next save removes.

Each field of a state is an item of its own, so that parameters can be read without moments. Every checkpoint also
carries the JSON description of its run (configurations, embodiment table, data provenance). Restoring under another
description is refused, and the error names the differences.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import os
import re
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
from orbax.checkpoint import v1 as ocp

from hma_jax.config import ConfigError
from hma_jax.config.json import diff
from hma_jax.runtime.files import IO_ERRNOS, sync, sync_tree
from hma_jax.runtime.processes import all_gather, is_writer, writer_first
from hma_jax.training.hashes import hash_files, write_list
from hma_jax.training.reading import (
    CheckpointError,
    agree_on_latest,
    error_code,
    find_damage,
    hush_orbax,
    list_steps,
    load_items,
    read_description,
    require_finished,
)
from hma_jax.training.run_lock import require_plain

Description = dict[str, Any]

UNFINISHED, REMOVED = ".unfinished", ".removed"
"""How the names of checkpoints end that are being written, or removed."""

LEFTOVER = re.compile(rf"[0-9]+(\{UNFINISHED}|\{REMOVED}|\.orbax-checkpoint-tmp)")
"""How these names begin, and those of the directories that Orbax writes into. Other names were given by a user who set
a checkpoint aside."""

TRIES = 10
"""Saving is given up after this many failures in a row because the disk did not answer: after about four minutes."""

LONGEST_PAUSE = 60.0
"""The longest time, in seconds, until a save is repeated; the first pauses are 1, 2, 4, ... seconds."""

T = TypeVar("T")

log = logging.getLogger(__name__)


class SaveError(OSError):
    """A file of a run could not be written. The run's last finished checkpoint is kept. `passing`: a disk or network
    failed that may answer again; `reason`: the system's message about a checkpoint."""

    def __init__(self, message: str, passing: bool = False, reason: str = ""):
        super().__init__(message)
        self.passing, self.reason = passing, reason


class Checkpoints:
    """The checkpoints of one run. Use as a context manager: leaving waits for pending saves."""

    def __init__(
        self,
        directory: Path,
        meta: Description,
        keep: int = 2,
        modernise: Callable[[Description], Description] = lambda described: described,
        keep_steps: tuple[int, ...] = (),
        keep_every: int = 0,
    ):
        """The newest `keep` checkpoints are kept, and those of `keep_steps` and of every `keep_every` steps (0: none).
        `modernise` converts a description that an earlier version wrote to the form of `meta`.

        Raises CheckpointError if `directory` cannot be written, and ConfigError if checkpoints there could not be read
        (`run_lock.require_plain`), or for a description that is not JSON.
        """
        require_plain(directory)
        try:
            json.dumps(meta)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"the description of a run, including its provenance, must be JSON: {error}") from error
        self.directory = Path(directory).absolute()
        self.meta, self.keep, self.modernise = meta, keep, modernise
        self.keep_steps, self.keep_every = keep_steps, keep_every
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CheckpointError(
                f"cannot create the checkpoint directory {self.directory}: {error.strerror}; "
                "choose another output directory"
            ) from error
        self._background = ThreadPoolExecutor(1, "checkpoint")
        self._pending: tuple[int, Future[OSError | None]] | None = None
        self._failed: list[SaveError] = []  # since the last save that succeeded
        self._repeat_at = 0.0  # time.monotonic()
        self._bytes = 0  # size of the state that was saved last

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, raised: BaseException | None, _: object) -> None:
        try:
            self.wait()
        except SaveError as error:
            if kind is None:
                raise
            if error is not raised:
                log.warning("%s", error)  # the earlier exception is the one to raise
        finally:
            self._background.shutdown()

    @property
    def latest_step(self) -> int | None:
        return max(list_steps(self.directory), default=None)

    # --- Saving ------------------------------------------------------------------------------

    def save(self, step: int, state: Any) -> None:
        """Starts an asynchronous save of a named tuple, with an item per field that is not None. The arrays are copied
        before this returns.

        Raises SaveError if this save or the one before it failed, unless it is to be repeated (`to_repeat`).
        """
        self._bear(self._settle())
        items = {name: item for name, item in state._asdict().items() if item is not None}
        self._bytes = sum(x.nbytes for x in jax.tree.leaves(items))
        hush_orbax()
        try:
            _require_writable(self.directory)
            if is_writer():
                self._remove_leftovers()
            response = ocp.save_checkpointables_async(
                self._unfinished(step), items, overwrite=True, custom_metadata=self.meta
            )
        except Exception as error:
            self._bear(self._failure(step, error))
        else:
            self._pending = step, self._background.submit(self._finish, step, response)

    def raise_failure(self) -> None:
        """Raises the SaveError of a save that has failed in the meantime, unless it is to be repeated. Does not wait
        for a save that is running."""
        if self._pending is not None and self._pending[1].done():
            self._bear(self._settle())

    @property
    def to_repeat(self) -> bool:
        """Whether it is time to save again, because a disk did not answer when the last save was written."""
        return bool(self._failed) and self._pending is None and time.monotonic() >= self._repeat_at

    def finish(self, step: int, state: Any) -> None:
        """Waits until the save of `step`, which was started before, is complete; repeats it where that may help. Raises
        SaveError."""
        self._bear(self._settle())
        while self._failed:
            time.sleep(max(self._repeat_at - time.monotonic(), 0))
            self.save(step, state)
            self._bear(self._settle())

    def wait(self) -> None:
        """Waits until the last save is complete. Raises SaveError if it could not be written."""
        error = self._settle()
        if error or self._failed:
            raise error or self._failed[-1]

    def _settle(self) -> SaveError | None:
        """Waits for the last save. Returns its error if the save can be repeated, and raises it otherwise."""
        if self._pending is None:
            return None
        (step, future), self._pending = self._pending, None
        try:
            error = future.result()
        except Exception as orbax:
            return self._failure(step, orbax)
        if error is not None:
            return self._failure(step, error, agreed=True)
        self._failed.clear()
        return None

    def _bear(self, error: SaveError | None) -> None:
        """Notes that a failed save is to be repeated. Raises its error after `TRIES` failures in a row."""
        if error is None:
            return
        self._failed.append(error)
        if len(self._failed) == TRIES:
            raise error
        pause = min(2.0 ** (len(self._failed) - 1), LONGEST_PAUSE)
        self._repeat_at = time.monotonic() + pause
        log.warning("%s; the run goes on, and saves again in %.0f s", error.args[0].partition(". ")[0], pause)

    def _finish(self, step: int, response: Any) -> OSError | None:
        """Runs in the background: waits for Orbax, then flushes and lists its files, and gives the checkpoint its name.
        Every process flushes and hashes its own shards. Returns the error, the same in all processes, if this fails."""
        response.result()
        try:
            told = _in_all("hashes", lambda: [] if is_writer() else _own_shards(self._unfinished(step)))
            _in_all("checkpoint", lambda: self._complete(step, sum(told, [])) if is_writer() else None)
        except OSError as error:
            return error
        return None

    def _complete(self, step: int, rows: list[Any]) -> None:
        unfinished = self._unfinished(step)
        sync_tree(unfinished)  # Orbax flushes only arrays, neither its other files nor their names
        write_list(unfinished, rows)
        if not (self.directory / str(step)).exists():  # otherwise only the flush after the renaming had failed
            os.replace(unfinished, self.directory / str(step))
        sync(self.directory)
        for old in list_steps(self.directory)[: -self.keep]:
            kept = old in self.keep_steps or self.keep_every and old % self.keep_every == 0
            if not kept:
                with suppress(FileNotFoundError):  # renamed first: a numbered directory is never half removed
                    os.replace(self.directory / str(old), self.directory / f"{old}{REMOVED}")
        self._remove_leftovers()

    def _remove_leftovers(self) -> None:
        for path in self.directory.iterdir():
            if LEFTOVER.match(path.name):
                shutil.rmtree(path, ignore_errors=True)

    def _unfinished(self, step: int) -> Path:
        return self.directory / f"{step}{UNFINISHED}"

    def _failure(self, step: int, error: Exception, agreed: bool = False) -> SaveError:
        """The error of a failed save. Raises it where repeating the save would not help (the disk is full, say), or
        where other processes may not know of the failure."""
        reason = _reason(error)
        try:
            latest = self.latest_step
        except OSError:  # the disk still does not answer
            again = "it continues from the last complete checkpoint"
        else:
            again = f"it continues from step {latest}, the last complete checkpoint"
            if latest is None:
                again = "it starts from step 0, since there is no checkpoint yet"
        failure = SaveError(
            f"the checkpoint of step {step} could not be written to {self.directory}: {reason}. {self._space()}Make "
            f"sure that there is space and permission to write, then run the same command again: {again}",
            passing=error_code(error) in IO_ERRNOS,
            reason=reason,
        )
        if failure.passing and (agreed or jax.process_count() == 1):
            return failure
        raise failure from error

    def _space(self) -> str:
        try:
            free = shutil.disk_usage(self.directory).free
        except OSError:  # the directory itself is gone
            return ""
        return f"It takes about {_size(self._bytes)}, and {_size(free)} are free there. "

    # --- Restoring ---------------------------------------------------------------------------

    def restore(
        self,
        shapes: Any,
        may_change: Callable[[Description, int], tuple[str, ...]] = lambda saved, step: (),
        skip_damaged: bool = False,
    ) -> tuple[int, Any]:
        """(step, state) of the latest checkpoint, laid out as `shapes` (jax.ShapeDtypeStruct) say.

        `may_change(description, step)` gives the fields of the checkpoint's description (such as 'train.steps') that
        may differ. With `skip_damaged`, damaged checkpoints after the newest whole one are moved to `damaged` beside
        this directory. Raises CheckpointError, which names every other difference or the damaged file, and ReadError if
        a file cannot be read at the moment.
        """
        if skip_damaged:
            with writer_first("damaged checkpoints"):
                if is_writer():
                    self._move_damaged_away()
        step = agree_on_latest(self.directory)
        if step is None:
            raise CheckpointError(f"no checkpoint in {self.directory}")
        checkpoint = self.directory / str(step)
        require_finished(checkpoint)
        saved = read_description(checkpoint)
        if saved.keys() != self.meta.keys():
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) belongs to another kind of run: it describes "
                f"{', '.join(sorted(saved)) or 'nothing'}, not {', '.join(sorted(self.meta))}; use a new output "
                "directory"
            )
        saved = self.modernise(saved)
        free = may_change(saved, step)
        changes = [line for line in diff(saved, self.meta) if line.split(":")[0] not in free]
        if changes:
            raise CheckpointError(
                f"the checkpoint at {self.directory} (step {step}) was made with another configuration; use a new "
                "output directory, go on in a branch (`hma branch`: other learning rate, masks, seed or steps), or restore "
                "these fields:\n  " + "\n  ".join(changes)
            )
        wanted = {name: item for name, item in shapes._asdict().items() if item is not None}
        return step, type(shapes)(**load_items(checkpoint, wanted))

    def _move_damaged_away(self) -> None:
        damaged = []
        for step in reversed(list_steps(self.directory)):
            damage = find_damage(self.directory / str(step))
            if damage is None:
                break
            damaged.append((step, damage))
        else:
            raise CheckpointError(
                f"all checkpoints in {self.directory} are damaged; train again in a new output directory"
            )
        for step, damage in damaged:
            aside = self.directory.parent / "damaged" / str(step)
            while aside.exists():
                aside = aside.with_name(f"{aside.name}-again")
            aside.parent.mkdir(exist_ok=True)
            os.replace(self.directory / str(step), aside)
            log.warning("the checkpoint of step %d is damaged (%s) and was moved to %s", step, damage, aside)


def _require_writable(directory: Path) -> None:
    """Raises OSError if nothing can be created in `directory`. Otherwise Orbax would fail in a thread for which others
    then wait for ever."""
    if not os.access(directory, os.W_OK | os.X_OK):
        read_only = os.statvfs(directory).f_flag & os.ST_RDONLY  # raises OSError if it is gone, or does not answer
        code = errno.EROFS if read_only else errno.EACCES
        raise OSError(code, os.strerror(code), str(directory))


def _own_shards(checkpoint: Path) -> list[Any]:
    """Flushes and hashes the files that only this process wrote. The writer does so for all other files, and for those
    that a shared disk does not show here yet."""
    own = f"/ocdbt.process_{jax.process_index()}/"
    rows = hash_files(checkpoint, lambda name: own in name)
    for row in rows:
        sync(checkpoint / row[0])
    return rows


def _in_all(name: str, act: Callable[[], T]) -> list[T]:
    """What `act` returns in each process; all processes call this. An OSError in any of them is raised in all."""
    try:
        own = {"result": act()}
    except OSError as error:
        own = {"failed": error_code(error), "reason": _reason(error)}
    told = [json.loads(text) for text in all_gather(f"saved/{name}", json.dumps(own))]
    for one in told:
        if "failed" in one:
            raise OSError(one["failed"], one["reason"])
    return [one["result"] for one in told]


def _size(count: int) -> str:
    """A number of bytes with a unit: '7.34 GB'."""
    power = min(int(math.log10(max(count, 1)) / 3), 4)
    return f"{count / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB')[power]}"


def _reason(error: Exception) -> str:
    """One line: the operating system's message, if there is one."""
    if code := error_code(error):
        return os.strerror(code)
    return " ".join(f"{type(error).__name__}: {error}".split())[:160]
