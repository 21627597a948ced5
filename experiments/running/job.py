"""job.json, the description from which a process runs one trial."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from experiments.running.attempts import JOB
from experiments.running.provenance import Provenance
from experiments.running.shared_runs import SharedTraining
from experiments.running.trial import Trial
from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.config.json import from_dict


def read_job(record: dict[str, Any]) -> tuple[Trial, ExecutionConfig, SharedTraining]:
    """(the trial, how it is computed, what it shares with others). Fields that were added after the job was written
    take their defaults. Raises ConfigError for a record that is not a job."""
    try:
        trial, execution = record["trial"], record["execution"]
    except (KeyError, TypeError) as error:
        raise ConfigError(f"job.json: not a job of this project ({error!r}); run its study again") from error
    shared = from_dict(SharedTraining, record.get("shared", {}))
    return from_dict(Trial, trial), from_dict(ExecutionConfig, execution), shared


def trial_in(directory: Path) -> tuple[Trial, Provenance]:
    """A finished trial and what it depends on, from its job.json. Raises ConfigError if that cannot be read."""
    try:
        job = json.loads((directory / JOB).read_text())
        return read_job(job)[0], from_dict(Provenance, job["provenance"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{directory}: the description of the finished trial cannot be read ({error}); copy the trial again from "
            "where it ran, or remove the directory to run it again"
        ) from error
