"""The sealed result of a trial: it holds hashes of the files it was computed from, and of itself.

So a finished trial can be copied between machines, and truncated or edited files are detected. This does not protect
against deliberate forgery, which could recompute the hashes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from experiments.running import provenance
from experiments.running.attempts import RESULT, RUN
from hma_jax.config import ConfigError, require
from hma_jax.config.json import stable_hash
from hma_jax.evaluation.windows import FILE as WINDOWS
from hma_jax.runtime.files import hash_file, write_file

SAMPLES = "samples.npz"

SEALED = (WINDOWS, SAMPLES, f"{RUN}/metrics.jsonl", provenance.FILE)
"""Files beside a result that it vouches for, if they exist. Checkpoints are not among them: no number is read from them
again, and a copy may leave them out."""

SPARED = (SAMPLES,)
"""Files among `SEALED` that no number depends on and that are most of a trial's bytes: a copy may leave them out."""


def write_result(directory: Path, result: dict[str, Any]) -> None:
    """Writes result.json, the last file of a trial, in the directory that bears its id."""
    files = {name: hash_file(directory / name) for name in SEALED if (directory / name).is_file()}
    values = json.loads(json.dumps({**result, "trial": directory.name, "files": files}))
    write_file(directory / RESULT, json.dumps({"hash": stable_hash(values), **values}, indent=1))


def read_result(directory: Path) -> dict[str, Any]:
    """Raises ConfigError unless result.json and the files that it was computed from are as they were written."""
    try:
        values = json.loads((directory / RESULT).read_text())
        stated = values.pop("hash")
        require(stable_hash(values) == stated, f"{RESULT} was changed, it does not match its hash {stated}")
        require(values["trial"] == directory.name, f"{RESULT} is of trial {values['trial']}")
        for name, digest in values["files"].items():
            path = directory / name
            if name in SPARED and not path.exists():
                continue
            require(path.is_file(), f"{name} is missing")
            require(hash_file(path) == digest, f"{name} was changed, or cut off, after {RESULT} was written")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"no {error} in {RESULT}" if isinstance(error, KeyError) else error
        raise ConfigError(
            f"{directory / RESULT}: the finished trial is damaged: {reason}. Copy it again from where it ran, or "
            "remove its directory to run it again"
        ) from error
    return values
