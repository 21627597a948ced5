"""What the process of one trial is told: job.json, as it is written today and as earlier versions wrote it."""

from __future__ import annotations

from typing import Any

from experiments.trial import Trial
from hma_jax.config import ConfigError, ExecutionConfig
from hma_jax.config.json import from_dict
from hma_jax.training.runs import FORMER_FIELDS

REMAT = {True: "everything", False: "products"}
ATTENTION = {"by_frame": "auto", "whole": "plain"}
"""What was said in an earlier version's fields of these names, in today's words."""


def read_job(record: dict[str, Any]) -> tuple[Trial, ExecutionConfig]:
    """(the trial, how it is computed). Fields that came after the job was written take their defaults.

    Earlier versions counted how a trial is computed to the trial itself. Raises ConfigError for what is no job.
    """
    try:
        trial = {**record["trial"]}
        former = {name: {**trial[name]} for name in FORMER_FIELDS}
        execution = record.get("execution") or {"mesh": record["mesh"]}
    except (KeyError, TypeError) as error:
        raise ConfigError(f"job.json: not a job of this project ({error!r}); run its study again") from error
    said = {key: part.pop(key) for name, part in former.items() for key in FORMER_FIELDS[name] if key in part}
    if said:
        execution = execution | {
            "dtype": said["compute_dtype"],
            "remat": REMAT[said["remat"]],
            "attention": ATTENTION[said["attention"]],
            "accumulate": said["accumulate"],
        }
    return from_dict(Trial, trial | former), from_dict(ExecutionConfig, execution)
