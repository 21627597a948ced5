"""The process of one trial: `python -m experiments.running.trial_main DIRECTORY`.

Reads DIRECTORY/job.json, runs the trial, and on failure leaves DIRECTORY/failure.json with
the state and one message. A trial whose sources are not those that job.json names is refused before any work.
The runner starts this; run it by hand to debug a trial.
"""

from __future__ import annotations

import json
import sys
import time
import traceback
from pathlib import Path

from experiments.running.children import settle
from hma_jax.runtime.exits import Exit, terminated_like_interrupted

RESULT, FAILURE, PROGRESS, JOB = "result.json", "failure.json", "progress.json", "job.json"
STOPPED = Exit.STOPPED
"""Exit code of a trial that was asked to stop and saved its state."""


def main(directory: Path) -> int:
    """0: finished; 1: failed or diverged (see failure.json); 2: refused, the sources changed; STOPPED: will resume."""
    settle()  # before anything imports JAX

    job = json.loads((directory / JOB).read_text())
    closure = _load_sources(directory, job.get("code"))
    if closure is None:
        return Exit.REFUSED

    from data_pipelines.errors import DataError
    from data_pipelines.publishing.files import write_file
    from experiments.job import read_job
    from experiments.running.ledger import DIVERGED, FAILED
    from experiments.running.provenance import inputs_of, record_start
    from experiments.trial import run_trial
    from experiments.workspace import Workspace
    from hma_jax.config import ConfigError
    from hma_jax.training.divergence import DivergedError
    from hma_jax.training.loop import Interrupted

    report = _ProgressFile(directory / PROGRESS)
    try:
        trial, execution = read_job(job)
        record_start(directory, inputs_of(job["provenance"]), closure)
        with terminated_like_interrupted():  # also while it evaluates
            run_trial(trial, Workspace(directory.parent.parent), directory, execution=execution, progress=report)
        return 0
    except (Interrupted, KeyboardInterrupt):
        return STOPPED
    except Exception as error:  # the boundary of the process: every failure becomes a record
        traceback.print_exc()
        known = isinstance(error, (ConfigError, DataError, DivergedError))
        message = str(error) if known else f"{type(error).__name__}: {error}"
        state = DIVERGED if isinstance(error, DivergedError) else FAILED
        write_file(directory / FAILURE, json.dumps({"state": state, "message": message}))
        return 1


def _load_sources(directory: Path, given: dict[str, str] | None) -> dict[str, str] | None:
    """The closure of what is run, imported; None if it is not what was given, of which failure.json is left."""
    from data_pipelines.publishing.files import write_file
    from experiments.running.ledger import REFUSED
    from experiments.running.provenance import CodeChanged, load_sources

    try:
        return load_sources(given)
    except CodeChanged as error:
        write_file(directory / FAILURE, json.dumps({"state": REFUSED, "message": str(error)}))
        return None


class _ProgressFile:
    """Writes {phase, done, total} for the runner to show, a few times a second at most."""

    def __init__(self, path: Path):
        self.path = path
        self.last = ("", 0.0)

    def __call__(self, phase: str, done: int, total: int) -> None:
        now = time.monotonic()
        if phase == self.last[0] and now - self.last[1] < 0.3 and done < total:
            return
        self.last = (phase, now)
        aside = self.path.with_suffix(".tmp")
        aside.write_text(json.dumps({"phase": phase, "done": done, "total": total}))
        aside.replace(self.path)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).absolute()))
