"""The output directory of a study: where everything lies, and which study lives there."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from experiments.atomic import write_atomically
from experiments.provenance import Provenance
from experiments.study import Study
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict, to_dict


class Busy(ConfigError):
    """Another command is at work in the directory."""


@dataclass(frozen=True)
class Workspace:
    """Paths under `root`. Deleting any of them is safe: the next run makes it again."""

    root: Path

    @property
    def suite(self) -> Path:
        """Simulated RLDS datasets."""
        return self.root / "suite"

    @property
    def tokenizer(self) -> Path:
        return self.root / "tokenizer"

    @property
    def store(self) -> Path:
        """Token store."""
        return self.root / "tokens"

    @property
    def manifest(self) -> Path:
        """Frozen evaluation windows."""
        return self.root / "eval_manifest.json"

    @property
    def data_summary(self) -> Path:
        """Episodes and windows per dataset, as JSON."""
        return self.root / "data.json"

    @property
    def trials(self) -> Path:
        return self.root / "trials"

    @property
    def ledger(self) -> Path:
        return self.root / "ledger.jsonl"

    @property
    def results(self) -> Path:
        return self.root / "results.csv"

    @property
    def optima(self) -> Path:
        """Best learning rates per width, where they were swept."""
        return self.root / "optima.csv"

    @property
    def figures(self) -> Path:
        return self.root / "figures"

    @property
    def report(self) -> Path:
        return self.root / "report.html"

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Makes the directory and holds the right to write in it; a lock that dies with its process.

        Raises ConfigError if the directory cannot be written, Busy if another process holds it.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            lock = open(self.root / ".lock", "a+")
        except OSError as error:
            raise ConfigError(
                f"cannot write to {self.root}: {error.strerror}; choose another --out or fix its permissions"
            ) from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise Busy(
                    f"another command is at work in {self.root}; wait for it or choose another --out"
                ) from None
            yield


@dataclass(frozen=True)
class Record:
    """What study.json remembers, so that `hma report` and `hma sweep` need only --out."""

    study: Study
    data: tuple[str, ...] = ()  # RLDS directories of the user; () for the suite
    axes: tuple[str, ...] = ()  # sweeps run so far
    command: str = ""
    provenance: Provenance | None = None  # of the trials that the report shows; None: not prepared yet


def save_record(workspace: Workspace, record: Record) -> None:
    write_atomically(workspace.root / "study.json", json.dumps(to_dict(record), indent=1))


def load_record(workspace: Workspace) -> Record:
    """Raises ConfigError if no study lives there."""
    path = workspace.root / "study.json"
    try:
        return from_dict(Record, json.loads(path.read_text()))
    except FileNotFoundError:
        raise ConfigError(
            f"no study in {workspace.root} (it has no study.json); start one with "
            f"`hma study --out {workspace.root}`"
        ) from None
    except ValueError as error:
        raise ConfigError(f"{path} is damaged ({error}); delete it and run the study's command again") from error


def merge_axes(workspace: Workspace, study: Study, axes: Sequence[str]) -> tuple[str, ...]:
    """`axes` and those that the same study has run before in this workspace."""
    try:
        earlier = load_record(workspace)
    except ConfigError:
        return tuple(axes)
    return tuple(dict.fromkeys([*(earlier.axes if earlier.study == study else ()), *axes]))
