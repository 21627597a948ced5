"""The table of successes: one row per policy, start, world and judge."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import numpy as np

from experiments.applications.judging.head import Head
from experiments.applications.judging.rollouts import Rollout
from experiments.applications.policies.tasks import AnyTask, held
from experiments.tables import write_table
from hma_jax.config import ConfigError

TRUE, LEARNED, SHUFFLED = "true", "learned", "shuffled"
WORLDS = (TRUE, LEARNED, SHUFFLED)
"""SHUFFLED: the learned world, where each episode executes what the policy does in another one."""

STATE, HEAD = "state", "head"


@dataclass(frozen=True)
class Outcome:
    """What one judge says about one episode. `start` counts the starts, `number` is the suite's seed of the start."""

    policy: str
    start: int
    number: int
    seed: int
    world: str
    judge: str
    success: bool


COLUMNS = [f.name for f in dataclasses.fields(Outcome)]


def judge_rollout(
    rollout: Rollout,
    head: Head,
    task: AnyTask,
    policy: str,
    world: str,
    numbers: Sequence[int],
    seeds: Sequence[int],
) -> list[Outcome]:
    """Judges by the head in every world, and by the state in the true one. The start itself does not count."""
    successes_by_judge = {HEAD: held(head.reached(rollout.images[:, 1:], rollout.images[:, :1]), task.hold).any(1)}
    if world == TRUE:
        successes_by_judge[STATE] = held(rollout.reached[:, 1:], task.hold).any(1)
    return [
        Outcome(policy, i, int(numbers[i]), int(seeds[i]), world, judge, bool(success))
        for judge, each in successes_by_judge.items()
        for i, success in enumerate(each)
    ]


def successes(outcomes: Iterable[Outcome], policies: Sequence[str], world: str, judge: str) -> np.ndarray:
    """bool [P, M] in the order of `policies` and starts."""
    rows = [[o for o in outcomes if (o.policy, o.world, o.judge) == (name, world, judge)] for name in policies]
    return np.array([[o.success for o in sorted(row, key=lambda o: o.start)] for row in rows])


def write_outcomes(outcomes: Sequence[Outcome], path: Path) -> None:
    write_table(path, COLUMNS, ([*dataclasses.astuple(o)[:-1], int(o.success)] for o in outcomes))


def read_outcomes(path: Path) -> list[Outcome]:
    """Reads outcomes. Raises ConfigError for a file that is damaged or something else."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [
                Outcome(policy, int(start), int(number), int(seed), world, judge, success == "1")
                for policy, start, number, seed, world, judge, success in map(
                    itemgetter(*COLUMNS), csv.DictReader(file)
                )
            ]
    except (OSError, ValueError, KeyError, TypeError) as error:  # TypeError: a row that was cut short
        raise ConfigError(f"{path} cannot be read as outcomes ({error}); run `hma judge` again") from error
