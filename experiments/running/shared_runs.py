"""Trials that share the beginning of their training: one constant phase of the learning rate, and a decay branch for
every number of steps (warmup-stable-decay).

Trials that differ only in their evaluation share all of it. Sharing changes no result: a trial that continues from
another one's checkpoint ends with the same bytes as one that was trained alone (`hma_jax.training.branch`). If the
others' checkpoints are missing, a trial is trained from its first step.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from experiments.running.attempts import RUN
from experiments.running.provenance import record_origin
from experiments.running.trial import Trial, training_of
from hma_jax.config import OptimizerConfig
from hma_jax.config.json import stable_hash


@dataclass(frozen=True)
class SharedTraining:
    """The steps of training that a trial shares with others."""

    before: tuple[tuple[str, int], ...] = ()  # (id, last common step) of trials with fewer steps: it waits for them
    keep: tuple[int, ...] = ()  # steps whose checkpoints are kept, for trials with more


def share_runs(trials: Mapping[str, Trial], former: Mapping[str, Trial] = {}) -> dict[str, SharedTraining]:
    """The shared training of every one of `trials`, by id. `former`: other finished trials in the study's directory
    (`trained.find_trained`)."""
    trained: dict[str, dict[str, int]] = defaultdict(dict)
    for id, trial in former.items():
        trained[stable_hash(training_of(trial))][id] = trial.train.steps
    families: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for id, trial in trials.items():
        families[stable_hash(training_of(trial))].append((trial.train.steps, id))
    found = {}
    for key, family in families.items():
        family.sort()
        for i, (steps, id) in enumerate(family):
            optimizer = trials[id].train.optimizer
            others = trained[key] | {other: n for n, other in family[:i]}
            common = [(other, common_steps(optimizer, steps, n)) for other, n in others.items()]
            keep = {common_steps(optimizer, steps, n) for n, _ in family[i + 1 :]} - {0}
            found[id] = SharedTraining(tuple((other, step) for other, step in common if step), tuple(sorted(keep)))
    return found


def common_steps(optimizer: OptimizerConfig, fewer: int, more: int) -> int:
    """The step up to which two runs are the same; 0: they differ from the beginning."""
    from hma_jax.training.optimizer import steps_in_common

    if fewer == more:  # the trials are judged in another way, or on other datasets
        return fewer
    return int(min(steps_in_common(optimizer, fewer, more), fewer, more))


def begin_shared(directory: Path, before: Iterable[tuple[str, int]]) -> tuple[str, int] | None:
    """Starts the trial in `directory` from the latest checkpoint that it shares with the trials `before` it.

    Its record then has the sources and machines of both. Returns whose checkpoint it was and its step; None if the
    trial starts on its own, or has begun already.
    """
    from hma_jax.training.branch import begin_from, has_checkpoint

    best, step = latest_common(directory.parent, before)
    if not step or has_checkpoint(directory / RUN):
        return None
    record_origin(directory, directory.parent / best)  # first: a copy that is cut short is made again
    begin_from(directory.parent / best / RUN, directory / RUN, step)
    return best, step


def latest_common(trials: Path, before: Iterable[tuple[str, int]]) -> tuple[str, int]:
    """Which of the trials `before` it has the latest checkpoint in common with a trial, and its step; 0 if none has
    any."""
    from hma_jax.training.branch import last_step

    common = [(last_step(trials / id / RUN, until), id) for id, until in before]
    step, id = max(common, key=lambda one: one[0], default=(0, ""))
    return id, step
