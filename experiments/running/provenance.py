"""What a trial's numbers depend on besides its configuration, and what is recorded about how they were made.

A trial is named by its configuration and its `Provenance`: inputs by their content, and one number that is raised
when a change to the code alters results. Nothing else is part of the name, neither the bytes of a source file nor a
machine, so that a trial is the same trial wherever it ran. The sources, versions and machine that it ran with are
recorded beside its numbers, in the trial's provenance.json, at every start of its process. The command that starts
trials gives each one the hashes of the sources that it found; a trial that finds other sources refuses to run, so that
no change of the code in the middle of a sweep goes unnoticed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from experiments.running.closure import Closure, changed, closure_hash, imported_modules, trace
from experiments.running.machine import describe_machine
from experiments.running.results_version import RESULTS_VERSION
from experiments.terminal.words import few
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict, to_dict
from hma_jax.runtime.files import write_file

FILE = "provenance.json"

ROOTS = tuple(f"experiments.running.{name}" for name in ("trial_main", "run_trial", "shared_runs", "initial_model"))
"""The modules whose closure is what a trial runs."""


@dataclass(frozen=True)
class Provenance:
    """The identity of each input, by its content; with a different input a trial is a different trial."""

    store: str  # of the token store
    manifest: str  # of the frozen evaluation windows
    tokenizer: str
    results: int = RESULTS_VERSION  # 0: from before they were numbered


class CodeChanged(ConfigError):
    """The sources are not those that a sweep was started with."""


class InputsChanged(ConfigError):
    """The study's tokens, windows or tokenizer are not those that a trial was planned with."""


@dataclass(frozen=True)
class Start:
    """What a process of the trial ran with. A start that is equal to the one before is not recorded again."""

    code: str  # hash of its closure
    machine: dict[str, Any]  # commit, versions, processor (`machine`)


@dataclass(frozen=True)
class TrialRecord:
    """The provenance.json of a trial."""

    inputs: Provenance
    closures: dict[str, dict[str, str]] = field(default_factory=dict)  # {hash: {module: hash}}, of every start
    besides: dict[str, str] = field(default_factory=dict)  # modules that were imported later and are in no closure
    starts: tuple[Start, ...] = ()

    @property
    def code(self) -> str:
        """The closure of the process that finished the trial."""
        return self.starts[-1].code if self.starts else ""

    def sources(self) -> dict[str, dict[str, str]]:
        """Every module that the trial ran, for the hash of each closure."""
        return {code: closure | self.besides for code, closure in self.closures.items()}


def trial_closure() -> dict[str, str]:
    """The sources that a trial started now would run. Raises CodeChanged if they cannot be read at the moment."""
    try:
        return trace(ROOTS)
    except (OSError, SyntaxError, ValueError) as error:  # in the middle of a `git pull`, say
        raise CodeChanged(f"the source files cannot be read ({error}); try again when they are complete") from error


def load_sources(given: Closure | None) -> dict[str, str]:
    """Imports everything that a trial runs, and returns the closure that was imported. To be called before any work.

    Raises CodeChanged if it is not the one `given` by the runner (None: the trial was started by hand), or if files
    changed meanwhile. From then on, the only sources read from disk are those that the trial's record lists as
    `besides`.
    """
    closure = trial_closure()
    _require_same(closure if given is None else given, closure)
    for name in closure:
        import_module(name)
    _require_same(closure, trial_closure())
    return closure


def _require_same(given: Closure, found: Closure) -> None:
    names = changed(given, found) + sorted(given.keys() ^ found.keys())
    if names:
        raise CodeChanged(
            f"the sources changed since this sweep was started: {few(names)}. The trial was not run. If the change alters "
            "no result, run the command again with --accept-code: trials that have run under the earlier sources are then "
            "counted apart. Or go back to the earlier sources"
        )


def record_start(directory: Path, inputs: Provenance, closure: Closure) -> None:
    """Records in a trial's directory with what it starts or continues. Raises ConfigError for a damaged record
    there."""
    known = read_record(directory) or TrialRecord(inputs)
    start = Start(closure_hash(closure), describe_machine())
    starts = known.starts if known.starts[-1:] == (start,) else (*known.starts, start)
    _save(directory, replace(known, closures=known.closures | {start.code: dict(closure)}, starts=starts))


def record_end(directory: Path) -> None:
    """Records what else the process has imported, on branches that few trials take."""
    known = read_record(directory)
    if known is not None:
        own = known.closures[known.code]
        later = {name: hash for name, hash in imported_modules().items() if name not in own}
        _save(directory, replace(known, besides=known.besides | later))


def record_origin(directory: Path, source: Path) -> None:
    """Records that a trial continues from what the trial in `source` computed, with that trial's sources and
    machines."""
    before, known = read_record(source), read_record(directory)
    if before is not None and known is not None:
        starts = tuple(start for start in before.starts if start not in known.starts) + known.starts
        merged = {"closures": before.closures | known.closures, "besides": before.besides | known.besides}
        _save(directory, replace(known, starts=starts, **merged))


def read_record(directory: Path) -> TrialRecord | None:
    """The record in `directory`; None if there is none. Raises ConfigError for one that cannot be read."""
    path = directory / FILE
    try:
        return from_dict(TrialRecord, json.loads(path.read_text()))
    except FileNotFoundError:
        return None
    except ValueError as error:  # ConfigError is one
        raise ConfigError(f"{path}: not a record of a trial ({error}); remove {directory} to run it again") from error


def _save(directory: Path, record: TrialRecord) -> None:
    write_file(directory / FILE, json.dumps(to_dict(record), indent=1))
