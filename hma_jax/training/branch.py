"""A run that starts from a checkpoint of another: the steps that both have in common are trained once.

With the schedule wsd, runs that differ in their number of steps alone are the same until the earlier one decays
(`optimizer.steps_in_common`). A run that continues from there leaves the same bytes as one that was trained from its
first step, for an optimiser step depends on the state and the step's number and on nothing else.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from hma_jax.runtime.files import sync, sync_tree
from hma_jax.training.reading import list_steps
from hma_jax.training.run_lock import CHECKPOINTS

LOGS = ("metrics.jsonl", "validation.jsonl", "timing.jsonl")
"""Cut after the step from which a run goes on when it starts (`log.RunLog`)."""


def last_step(run_dir: Path, latest: int) -> int:
    """The last step up to `latest` of which a run has a checkpoint; 0 without one."""
    return max((step for step in list_steps(run_dir / CHECKPOINTS) if step <= latest), default=0)


def has_checkpoint(run_dir: Path) -> bool:
    """Whether a run has a checkpoint."""
    return bool(list_steps(run_dir / CHECKPOINTS))


def begin_from(source: Path, run_dir: Path, latest: int) -> int | None:
    """Puts into `run_dir` the last checkpoint of `source` up to step `latest`, and what was logged until then.

    Returns its step; None, and nothing is done, without one, or if `run_dir` has a checkpoint of its own. The
    checkpoint appears whole or not at all, after the logs, also if the power fails. Whether the two runs agree is
    checked when it is restored. Raises OSError.
    """
    step = last_step(source, latest)
    if not step or has_checkpoint(run_dir):
        return None
    place = run_dir / CHECKPOINTS / str(step)
    place.parent.mkdir(parents=True, exist_ok=True)
    for name in LOGS:
        if (source / name).exists():
            shutil.copyfile(source / name, run_dir / name)
            sync(run_dir / name)
    sync(run_dir)
    aside = run_dir / f".{step}.copied"
    shutil.rmtree(aside, ignore_errors=True)  # of a copy that was cut short
    shutil.copytree(source / CHECKPOINTS / str(step), aside)
    sync_tree(aside)
    os.replace(aside, place)
    sync(place.parent)
    return step
