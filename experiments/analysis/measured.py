"""The measured losses to which a curve is fitted, and bootstrap draws of them over seeds and episodes.

Episodes are drawn by `bootstrap`: all trials are judged on the same frozen windows, so a draw takes the same episodes
for all of them, and what makes an episode hard shifts the whole curve but does not change its shape. Seeds are drawn
here, since a fit is made to every trial, not to the mean over seeds: an outlier among them then has little weight.

If every seed is judged on its own robots, the difficulty of these is removed: each seed is shifted, in the logarithm,
to the mean level of all. Their windows differ, so only seeds are drawn. Levels are estimated from the same losses,
which makes the seeds of a position appear to scatter less: their spread is corrected for the degrees of freedom that
the levels took.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from experiments.analysis.bootstrap import Panel, make_panel, resample
from experiments.analysis.paired import NotComparable
from hma_jax.config import require
from hma_jax.evaluation.windows import WindowTable

PRIOR = 4.0
"""Number of observations that the pooled variance over seeds counts as, beside those of a point: three seeds say
little."""


class NoLevel(NotComparable):
    """Every seed has its own robots, and no finished trials show how hard these are."""


@dataclass(frozen=True)
class Measurements:
    """A loss in nats per token of n trials at positions `x` on K axes."""

    axes: tuple[str, ...]  # K names, such as "trunk parameters"
    x: np.ndarray  # [n, K]
    run: np.ndarray  # [n], str: points of one run (a trial and its decay branches) share their seeds' luck
    trial: tuple[str, ...]  # n ids
    seed: np.ndarray  # [n], int
    value: np.ndarray  # [n]: mean over windows, then over robots
    panel: Panel | None  # of their windows, each trial a point with one seed; None: seeds have different windows
    levels: int = 0  # differences between seeds that were estimated from these losses and removed from `value`

    def __post_init__(self):
        lengths = {len(x) for x in (self.x, self.run, self.trial, self.seed, self.value)}
        lengths |= {len(self.panel.points)} if self.panel else set()
        require(len(lengths) == 1, f"the columns of measured trials differ in length: {sorted(lengths)}")

    @cached_property
    def points(self) -> np.ndarray:
        """[n]: the number of the distinct position of each trial."""
        return np.unique(self.x, axis=0, return_inverse=True)[1].ravel()

    def seeds_per_point(self) -> int:
        """The smallest number of seeds at any position."""
        return int(np.bincount(self.points).min())

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter of S seeds at each of P positions, P (S - 1); (P - 1)(S - 1) if levels were
        removed."""
        return len(self.value) - len(np.unique(self.points)) - self.levels

    def _stretch(self) -> float:
        """Factor by which a seed's deviation from the mean of its position is too small because levels were removed:
        sqrt(P / (P - 1)) with all seeds at each of P positions."""
        return float(np.sqrt((self.freedom + self.levels) / self.freedom)) if self.freedom > 0 else 1.0

    def noise(self) -> np.ndarray:
        """[n]: standard deviation over seeds of the logarithm of a trial's loss, at its position.

        The variance of a position is combined with that of all, which counts as PRIOR further observations. nan if no
        position has two seeds, or if levels left nothing of their scatter.
        """
        logs, points = np.log(self.value), self.points
        count = np.bincount(points)
        mean = np.bincount(points, logs) / count
        squares = np.bincount(points, (self._stretch() * (logs - mean[points])) ** 2)
        freedom = count - 1
        if self.freedom < 1:
            return np.full(len(logs), np.nan)
        pooled = squares.sum() / freedom.sum()
        return np.sqrt((squares + PRIOR * pooled) / (freedom + PRIOR))[points]

    def draw(self, draws: int, rng: np.random.Generator, episodes: bool = True) -> np.ndarray:
        """[draws, n]: the losses with seeds, and unless told otherwise episodes, drawn with replacement.

        Seeds are drawn per run, so that branches of a run move together. A seed's deviation from the mean of its
        position is multiplied by sqrt(m / (m - 1)) for m seeds, and by `_stretch` if levels were removed: otherwise the
        spread of few seeds would be too small. Deviations are those of the logarithm, as in `noise`: beside a failed
        seed, those of the loss itself would take the others below zero. With a single seed the spread is unknown, and
        the loss stays as it is.
        """
        number = int(rng.integers(2**31))
        if self.panel is None:
            means_Rn = np.repeat(self.value[None], draws, 0)
        else:
            means_Rn = resample(self.panel, draws, number, over_seeds=False, over_episodes=episodes).drawn
        found = means_Rn.copy()
        for run in np.unique(self.run):
            own_run = self.run == run
            seeds = np.unique(self.seed[own_run])
            chosen_RS = rng.integers(0, len(seeds), (draws, len(seeds)))
            for point in np.unique(self.points[own_run]):
                at = np.flatnonzero(own_run & (self.points == point))
                at = at[np.argsort(self.seed[at])]
                m = len(at)
                if m < 2:
                    continue
                # If some seeds of the run are missing, the existing ones are drawn on their own.
                chosen = chosen_RS if m == len(seeds) else rng.integers(0, m, (draws, m))
                logs = np.log(means_Rn[:, at])
                centre = logs.mean(1, keepdims=True)
                times = self._stretch() * np.sqrt(m / (m - 1))
                found[:, at] = np.exp(centre + times * (np.take_along_axis(logs, chosen, 1) - centre))
        return found


@dataclass(frozen=True)
class Position:
    """A trial's position on the axes of a curve, and the robots it is judged on."""

    trial: str
    run: str
    seed: int
    x: tuple[float, ...]
    scope: tuple[str, ...]  # the robots that it is judged on


def measure(
    axes: Sequence[str], positions: Sequence[Position], tables: Mapping[str, WindowTable], metric: str = "cross_entropy"
) -> Measurements:
    """The losses of trials at `positions` from their `tables` of windows, each over its own robots.

    Raises NotComparable unless trials of the same robots were judged on the same windows, and NoLevel if they are of
    different robots that nothing makes comparable.
    """
    require(len(positions) > 0, "there is no finished trial")
    groups: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for i, position in enumerate(positions):
        groups[position.scope].append(i)
    panels = {
        scope: make_panel([{positions[i].seed: tables[positions[i].trial]} for i in own], metric, scope)
        for scope, own in groups.items()
    }
    value = np.zeros(len(positions))
    for scope, own in groups.items():
        value[own] = resample(panels[scope], 1, over_seeds=False, over_episodes=False).value
    seed = np.array([position.seed for position in positions])
    x = np.array([position.x for position in positions], float).reshape(len(positions), len(axes))
    panel = next(iter(panels.values())) if len(panels) == 1 else None
    return Measurements(
        tuple(axes), x, np.array([position.run for position in positions]), tuple(position.trial for position in positions), seed,
        value if panel else _levelled(value, x, seed), panel, 0 if panel else len(np.unique(seed)) - 1,
    )  # fmt: skip


def _levelled(value: np.ndarray, x: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Values [n], those of each seed multiplied by a factor that gives all seeds the same level over the positions that
    all of them have. Raises NoLevel if there is no such position."""
    points = np.unique(x, axis=0, return_inverse=True)[1].ravel()
    shared = set.intersection(*(set(points[seed == s].tolist()) for s in np.unique(seed)))
    if not shared:
        raise NoLevel("every seed was evaluated on other robots, and no position has a finished trial of every seed")
    logs, common = np.log(value), np.isin(points, list(shared))
    level = {s: logs[common & (seed == s)].mean() for s in np.unique(seed)}
    mean = np.mean(list(level.values()))
    return np.exp(logs + np.array([mean - level[s] for s in seed]))
