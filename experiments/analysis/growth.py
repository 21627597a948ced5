"""The effect of more trajectories, separately for robots that have more and for those whose data is exhausted.

The paper explains the plateau over trajectories by robots that have no more of them. If so, from each point of an axis
that caps trajectories to the next, only robots that get more of them should gain. Differences are paired window by
window, as in `changes`. Computed only if every robot keeps its share of the windows drawn: under a mixture that weights
robots by the trajectories used, robots without more trajectories lose windows to the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from experiments.analysis.changes import CHANGED, finished_by_x
from experiments.analysis.compare import Side, overall_difference
from experiments.analysis.paired import NoNumbers
from experiments.running.provenance import Provenance
from experiments.running.trial import Trial, trajectories_of, trial_id
from experiments.sweeps.robots import UNIFORM
from experiments.sweeps.sweep import POINT, Point, Sweep
from hma_jax.evaluation.windows import WindowTable

GROWS, EXHAUSTED = "grows", "exhausted"


@dataclass(frozen=True, kw_only=True)
class Growth:
    """The mean at `last` minus that at `first`, over the robots whose data grows between them, or over those whose data
    is exhausted."""

    sweep: str
    series: str
    first: float
    last: float
    data: str
    robots: int
    metric: str
    mean: float
    sem: float
    low: float
    high: float
    seeds: int
    n: int
    episodes: int


def find_growth(
    sweeps: Sequence[Sweep],
    provenance: Provenance,
    windows: Mapping[str, WindowTable],
    results: Mapping[str, Mapping[str, Any]],
    episodes: Mapping[str, int],
) -> list[Growth]:
    """The effect of growing data between neighbouring points that share seeds, along axes that change the cap on
    trajectories. A trial's trajectories are those that its entry of `results` counts, else its robots' training
    `episodes` up to the cap. Raises NotComparable."""
    found = []
    for sweep in (s for s in sweeps if s.fittable):
        for series in dict.fromkeys(p.series for p in sweep.points if p.role == POINT):
            own = [p for p in sweep.points if (p.role, p.series, p.scope) == (POINT, series, ())]
            if len({p.trial.max_trajectories for p in own}) > 1 and all(keeps_shares(p.trial) for p in own):
                used = {
                    p.trial: trajectories_of(p.trial, episodes, results.get(trial_id(p.trial, provenance))) for p in own
                }
                found += _along(sweep, series, own, provenance, windows, used)
    return found


def keeps_shares(trial: Trial) -> bool:
    """Whether each robot's share of the windows drawn does not depend on how many trajectories are used."""
    return trial.tau >= UNIFORM or trial.weighed == "all"


def _along(
    sweep: Sweep,
    series: str,
    points: Sequence[Point],
    provenance: Provenance,
    windows: Mapping[str, WindowTable],
    used: Mapping[Trial, Mapping[str, int]],
) -> list[Growth]:
    trials, found = finished_by_x(points, provenance, windows), []
    for first, last in pairwise(sorted(trials)):
        seeds = trials[first].keys() & trials[last].keys()
        if not seeds:
            continue
        # Subsets of one seed are nested, so a sum over seeds is larger if any seed has more.
        before, after = (sum((Counter(used[trials[x][s][0].trial]) for s in seeds), Counter()) for x in (first, last))
        known = [name for name in sweep.scope if name in before and name in after]
        groups = {
            GROWS: [name for name in known if after[name] > before[name]],
            EXHAUSTED: [name for name in known if after[name] <= before[name]],
        }
        b, a = (Side(f"{sweep.axis} {x:g}", {s: trials[x][s][1] for s in sorted(seeds)}, "") for x in (first, last))
        for data, robots in groups.items():
            for metric in CHANGED if robots else ():
                try:
                    d = overall_difference(a, b, metric, robots)
                except NoNumbers:  # as in `changes`
                    continue
                if d is not None:
                    found.append(
                        Growth(
                            sweep=sweep.name, series=series, first=first, last=last, data=data, robots=len(robots),
                            metric=metric, seeds=d.seeds, **vars(d.interval),
                        )
                    )  # fmt: skip
    return found
