"""A run that starts from a checkpoint of another run.

A run that was branched (`branch`) may continue with other settings of optimiser and masks, another order of data or
another number of steps: for example after a spike of the loss, or to extend a run from before its learning rate
decayed. Its checkpoints record where it was branched and how it was trained until then.

Trials share the steps that they have in common (`begin_from`). With the schedule wsd, runs that differ only in their
number of steps are the same until the decay of the shorter one (`optimizer.steps_in_common`). A run that continues from
there leaves the same bytes as one that was trained from its first step, because an optimiser step depends only on the
state and the step's number.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

from hma_jax.config import ConfigError, MaskingConfig, OptimizerConfig, require
from hma_jax.runtime.files import sync, sync_tree, write_file
from hma_jax.training.reading import list_steps, read_description
from hma_jax.training.run_lock import CHECKPOINTS, locked_run

LOGS = ("metrics.jsonl", "validation.jsonl", "timing.jsonl")
"""Logs that are cut after the step from which a run continues, when it starts (`log.RunLog`)."""

FILE = "branch.json"
"""The file, in a run that was branched, with the list of the branchings that led to it, {"step", "train"} each."""

MAY_CHANGE = (
    "train.steps",
    "train.seed",
    "provenance.loader.seed",  # with the seed: another order of data
    "provenance.branched",
    # What the state holds for each parameter depends on `matrices`.
    *(f"train.optimizer.{field.name}" for field in fields(OptimizerConfig) if field.name != "matrices"),
    *(f"train.masking.{field.name}" for field in fields(MaskingConfig) if field.name != "setting"),
)
"""Fields of a run's description that may differ when a branch begins to train."""


def last_step(run_dir: Path, latest: int) -> int:
    """The last step, up to `latest`, for which a run has a checkpoint; 0 without one."""
    return max((step for step in list_steps(run_dir / CHECKPOINTS) if step <= latest), default=0)


def has_checkpoint(run_dir: Path) -> bool:
    """Whether a run has a checkpoint."""
    return bool(list_steps(run_dir / CHECKPOINTS))


def begin_from(source: Path, run_dir: Path, latest: int) -> int | None:
    """Copies into `run_dir` the last checkpoint of `source` up to step `latest`, and the logs until then.

    Returns its step. Does nothing and returns None if there is none, or if `run_dir` has a checkpoint of its own. The
    checkpoint appears whole or not at all, after the logs, even if the power fails. Whether the two runs agree is
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
    shutil.rmtree(aside, ignore_errors=True)  # left by a copy that was cut short
    shutil.copytree(source / CHECKPOINTS / str(step), aside)
    sync_tree(aside)
    os.replace(aside, place)
    sync(place.parent)
    return step


def branch(source: Path, run_dir: Path, step: int | None = None) -> int:
    """Makes `run_dir` a run that has the checkpoint of `step` (None: the newest) of `source`, and that may continue
    from there with other settings (MAY_CHANGE). Returns the step.

    Raises ConfigError if `source` has no such checkpoint or `run_dir` has one; OSError, CheckpointError.
    """
    steps = list_steps(source / CHECKPOINTS)
    require(bool(steps), f"{source} has no checkpoint; give the directory of a training run that has saved one")
    step = max(steps) if step is None else step
    require(
        step in steps,
        f"{source} has no checkpoint of step {step:,}; it has those of {', '.join(f'{n:,}' for n in steps)}. "
        "`hma train --keep-every STEPS` keeps more of them",
    )
    require(
        step > 0,
        f"{source} was converted, so it has nothing to go on with but its weights: `hma train --from` starts with these",
    )
    described = read_description(source / CHECKPOINTS / str(step))
    require("train" in described, f"{source} is not a run of a model; give the directory of a training run")
    earlier = described["provenance"].get("branched", [])
    with locked_run(run_dir):
        require(not has_checkpoint(run_dir), f"{run_dir} is a run already; give the branch a directory of its own")
        write_file(run_dir / FILE, json.dumps([*earlier, {"step": step, "train": described["train"]}], indent=1))
        begin_from(source, run_dir, step)
    return step


def read_branchings(run_dir: Path) -> list[dict[str, Any]]:
    """The branchings that led to a run, in order; empty for a run that was not branched. Raises ConfigError for a
    damaged file, and for a branch without a checkpoint."""
    path = run_dir / FILE
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        require(
            isinstance(found, list) and all(isinstance(one["step"], int) for one in found), "it is no list of steps"
        )
    except (FileNotFoundError, NotADirectoryError):
        return []
    except (ValueError, TypeError, KeyError) as error:
        raise ConfigError(f"{path} is damaged ({error}); remove the run and branch it again") from error
    require(
        not found or has_checkpoint(run_dir),
        f"{run_dir} was branched from another run, but its copy of a checkpoint is not complete or was removed; "
        "remove the directory, and branch again",
    )
    return found
