"""Per robot, whether a model follows its actions, and how much of the true motion the actions decide.

One row per robot and metric: the mean with its interval over episodes and, where several seeds were judged, over
these (`bootstrap`), how many standard errors it is from the value of a deaf model (one whose predictions do not depend
on actions), and what share of the change of this robot's pixels its actions explain in truth
(`experiments.suite.explained`), where the model has the rate at which that was measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from data_pipelines.registry import FRAME_RATE
from experiments.analysis.bootstrap import Panel, bootstrap_intervals
from experiments.analysis.explained_share import read_shares
from experiments.analysis.intervals import standard_errors
from experiments.analysis.paired import require_same_windows
from experiments.sweeps.sweep import POINT
from hma_jax.config import require
from hma_jax.evaluation.windows import WindowTable

RETRIEVAL = "retrieval"
"""A share of windows, which is at chance for a deaf model."""

METRICS = ("delta_psnr", "action_nats", RETRIEVAL, "counterfactual_gain")
"""The others are 0 for a deaf model."""

FOLLOWING_SEMS = 2.0
"""A robot counts as following actions if it is more than this many standard errors above a deaf model."""

ROUNDING = 1e-5
"""dB or nats below which a mean counts as 0: rounding differs by this much between devices, and scatters so little that
it would look significant."""


@dataclass(frozen=True, kw_only=True)
class Controllability:
    """A line of the table; `mean` minus `deaf` is `errors` standard errors from zero."""

    robot: str
    metric: str
    mean: float
    sem: float
    low: float
    high: float
    deaf: float  # value of a model that is deaf to actions: 0, or the chance level of retrieval
    errors: float
    seeds: int
    n: int
    episodes: int
    explained: float = float("nan")  # share of the change of its pixels that actions decide; nan: not measured
    role: str = POINT  # or CONTROL: a model trained on the actions of other episodes, which has nothing to follow


def controllability(seeds: dict[int, WindowTable], role: str = POINT, *, rate: float | None) -> list[Controllability]:
    """Measures of controllability of one model, given its tables by seed, for that `role` and frame rate: one entry for
    each robot that has the metric, in the order of the tables.

    Raises NotComparable unless all seeds saw the same windows.
    """
    require(len(seeds) > 0, "there is no trial to compute controllability from")
    first, rows = next(iter(seeds.values())), []
    truth = read_shares() if rate == FRAME_RATE else {}  # over a step of another length it is another share
    matched = {}
    for seed, table in seeds.items():
        require_same_windows(first, table)
        matched[seed] = table.aligned_to(first)
    for robot in first.datasets:
        own = {seed: table.of(robot) for seed, table in matched.items()}
        share = truth[robot].share if robot in truth else float("nan")
        for metric in METRICS:
            if all(metric in table.metrics for table in own.values()):
                rows += _row(robot, metric, own, share, role)
    return rows


def count_following(rows: Iterable[Controllability], metric: str) -> tuple[int, int]:
    """(robots whose metric is more than FOLLOWING_SEMS standard errors above that of a deaf model, robots that have
    it)."""
    own = [row for row in rows if row.metric == metric]
    return sum(row.errors > FOLLOWING_SEMS for row in own), len(own)


def expected_by_chance(rows: Iterable[Controllability], metric: str) -> float | None:
    """How many of these robots would be counted for a model that follows nothing, on average: by Student's t with as
    many degrees of freedom as episodes less one, since few episodes make a rough standard error. A robot without
    actions, which has the value of a deaf model in every window, is never counted. None of retrieval: hits and misses
    of a few windows are not distributed like that."""
    if metric == RETRIEVAL:
        return None
    own = [row for row in rows if row.metric == metric and row.episodes > 1]
    freedom = [row.episodes - 1 for row in own if max(abs(row.mean - row.deaf), row.sem) > ROUNDING]
    return float(stdtr(freedom, -FOLLOWING_SEMS).sum())


def _row(robot: str, metric: str, tables: dict[int, WindowTable], share: float, role: str) -> Sequence[Controllability]:
    values = np.stack([table.metrics[metric] for table in tables.values()])
    known = ~np.isnan(values).any(0)
    if not known.any():
        return ()
    first = next(iter(tables.values()))
    deaf = float(np.mean(first.metrics["retrieval_chance"][known])) if metric == RETRIEVAL else 0.0
    panel = Panel(first.dataset[known], first.episode[known], (values[:, known],), (tuple(tables),))
    (interval,) = bootstrap_intervals(panel)
    interval = interval.of_share() if metric == RETRIEVAL else interval
    excess = interval.mean - deaf
    errors = standard_errors(0.0 if abs(excess) < ROUNDING else excess, interval.sem)
    return (
        Controllability(
            robot=robot, metric=metric, deaf=deaf, errors=errors, seeds=len(tables), explained=share, role=role,
            **vars(interval),
        ),
    )  # fmt: skip
