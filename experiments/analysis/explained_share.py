"""How much of the change of their pixels the actions of the suite's robots explain, as `experiments.suite.explained`
measured it."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

EXPLAINED = Path(__file__).parents[1] / "results" / "suite" / "explained.csv"


@dataclass(frozen=True)
class ExplainedShare:
    """A row of the table. `sem` is the standard error over states, `moved` the root mean square of
    x' - x in grey levels."""

    robot: str
    family: str
    action_values: int
    share: float
    sem: float
    moved: float


def read_shares() -> dict[str, ExplainedShare]:
    """The committed table, by robot."""
    with EXPLAINED.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        r["robot"]: ExplainedShare(
            r["robot"], r["family"], int(r["action_values"]), float(r["share"]), float(r["sem"]), float(r["moved"])
        )
        for r in rows
    }
