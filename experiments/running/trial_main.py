"""The process of one trial: `python -m experiments.running.trial_main DIRECTORY`.

Reads DIRECTORY/job.json, runs the trial, and on failure leaves DIRECTORY/failure.json with
the state and one message. A trial whose sources are not those that job.json names is refused before any work. The runner starts this; run it by hand to debug a trial.
"""

from __future__ import annotations

import json
import sys
import time
import traceback
from pathlib import Path

from experiments.running.children import settle

RESULT, FAILURE, PROGRESS, JOB = "result.json", "failure.json", "progress.json", "job.json"
STOPPED = 130
"""Exit code of a trial that was asked to stop and saved its state."""


def main(directory: Path) -> int:
    """0: finished; 1: failed or diverged (see failure.json); 2: refused, the sources changed; STOPPED: will resume."""
    settle()  # before anything imports JAX

    from data_pipelines.errors import DataError
    from data_pipelines.publishing.files import write_file
    from experiments.job import read_job
    from experiments.running.ledger import DIVERGED, FAILED, REFUSED
    from experiments.running.provenance import CodeChanged, inputs_of, load_sources, record_start
    from experiments.trial import run_trial
    from experiments.workspace import Workspace
    from hma_jax.config import ConfigError
    from hma_jax.training.loop import DivergedError, Interrupted

    job = json.loads((directory / JOB).read_text())
    report = _ProgressFile(directory / PROGRESS)
    try:
        trial, execution = read_job(job)
        closure = load_sources(job.get("code"))
        record_start(directory, inputs_of(job["provenance"]), closure)
        run_trial(trial, Workspace(directory.parent.parent), directory, execution=execution, progress=report)
        return 0
    except (Interrupted, KeyboardInterrupt):
        return STOPPED
    except CodeChanged as error:
        write_file(directory / FAILURE, json.dumps({"state": REFUSED, "message": str(error)}))
        return 2
    except Exception as error:  # the boundary of the process: every failure becomes a record
        traceback.print_exc()
        known = isinstance(error, (ConfigError, DataError, DivergedError))
        message = str(error) if known else f"{type(error).__name__}: {error}"
        state = DIVERGED if isinstance(error, DivergedError) else FAILED
        write_file(directory / FAILURE, json.dumps({"state": state, "message": message}))
        return 1


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
