"""Finished trials in a study's directory whose training the trials to be run can share.

They may be of the study's other axes, or of an earlier evaluation: a study whose `eval` was changed (`--replace study`)
has trials with other names but the same training.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from experiments.running.attempts import RESULT, RUN
from experiments.running.closure import Closure, changed
from experiments.running.job import trial_in
from experiments.running.provenance import Provenance, read_record
from experiments.running.trial import Trial, trial_id
from hma_jax.config import ConfigError
from hma_jax.training.run_lock import CHECKPOINTS


def find_trained(
    trials: Path, ids: Collection[str], provenance: Provenance, sources: Closure | None
) -> dict[str, Trial]:
    """Finished trials in `trials` besides `ids`, by id, that have checkpoints, were trained on the same tokens, and
    have the id that today's code gives them.

    `sources`: the sources that they must have run; None: any. A trial that cannot be read is left out.
    """
    found = {}
    for directory in sorted(path.parent for path in trials.glob(f"*/{RESULT}") if path.parent.name not in ids):
        if not (directory / RUN / CHECKPOINTS).is_dir():
            continue
        try:
            (trial, inputs), ran = trial_in(directory), read_record(directory)
        except (OSError, ConfigError):
            continue
        alike = replace(inputs, manifest=provenance.manifest) == provenance  # the manifest is what it is judged on
        same = sources is None or (ran is not None and not any(changed(c, sources) for c in ran.sources().values()))
        if alike and same and trial_id(trial, inputs) == directory.name:
            found[directory.name] = trial
    return found
