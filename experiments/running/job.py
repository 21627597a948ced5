"""job.json, the description from which a process runs one trial, as written today and by earlier versions."""

from __future__ import annotations

from typing import Any

from experiments.running.migration import migrate
from experiments.running.shared_runs import SharedTraining
from experiments.running.trial import Trial
from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.config.json import from_dict


def read_job(record: dict[str, Any]) -> tuple[Trial, ExecutionConfig, SharedTraining]:
    """(the trial, how it is computed, what it shares with others). Fields that came after the job was written take
    their defaults.

    Earlier versions counted how a trial is computed to the trial itself. Raises ConfigError for what is no job.
    """
    try:
        trial, former_execution = migrate(record["trial"])
        execution = record.get("execution") or {"mesh": record["mesh"]}
    except (KeyError, TypeError) as error:
        raise ConfigError(f"job.json: not a job of this project ({error!r}); run its study again") from error
    shared = from_dict(SharedTraining, record.get("shared", {}))
    return from_dict(Trial, trial), from_dict(ExecutionConfig, execution | former_execution), shared
