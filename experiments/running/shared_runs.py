"""Trials that share the beginning of their training: one constant phase, a decay for every number of steps.

What a trial is and what it computes does not depend on it: a trial that goes on from another one's checkpoint ends
with the same bytes as one that was trained alone (`hma_jax.training.branch`). Where the others are not there, or ran
elsewhere, it is trained from its first step.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from experiments.running.attempts import RUN
from experiments.running.trial import Trial, training_of
from hma_jax.config import OptimizerConfig
from hma_jax.config.json import stable_hash


@dataclass(frozen=True)
class Shared:
    """What a trial has in common with others."""

    before: tuple[tuple[str, int], ...] = ()  # (id, last common step) of those with fewer steps: it waits for them
    keep: tuple[int, ...] = ()  # steps after which its checkpoint stays, for those with more


ALONE = Shared()


def share_runs(trials: Mapping[str, Trial]) -> dict[str, Shared]:
    """For every trial of a study, by id. Trials of as many steps that are judged otherwise share as well."""
    families: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for id, trial in trials.items():
        families[stable_hash(training_of(trial))].append((trial.train.steps, id))
    found = {}
    for family in map(sorted, families.values()):
        for i, (steps, id) in enumerate(family):
            optimizer = trials[id].train.optimizer
            common = [(other, common_steps(optimizer, steps, n)) for n, other in family[:i]]
            keep = {common_steps(optimizer, steps, n) for n, _ in family[i + 1 :]} - {0}
            found[id] = Shared(tuple((other, step) for other, step in common if step), tuple(sorted(keep)))
    return found


def common_steps(optimizer: OptimizerConfig, fewer: int, more: int) -> int:
    """Up to which step two runs are the same; 0: they differ from the beginning."""
    from hma_jax.training.optimizer import steps_in_common

    return int(min(steps_in_common(optimizer, fewer, more), fewer, more))


def begin_shared(directory: Path, before: Iterable[tuple[str, int]]) -> tuple[str, int] | None:
    """Lets the trial in `directory` go on from the latest checkpoint that it has in common with those `before` it.

    Returns whose it was and its step; None if it begins by itself, or has begun.
    """
    from hma_jax.training.branch import begin_from, last_step

    runs = {id: directory.parent / id / RUN for id, _ in before}
    there = {id: last_step(runs[id], until) for id, until in before}
    best = max(there, key=lambda id: there[id], default=None)
    if best is None or not there[best] or begin_from(runs[best], directory / RUN, there[best]) is None:
        return None
    return best, there[best]
