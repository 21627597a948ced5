"""The losses that a curve is fitted to, and how they would scatter with other seeds and other episodes.

All trials are judged on the same frozen windows, so that a bootstrap draws the same episodes for all of them: what
makes an episode hard moves the whole curve and not its shape. Datasets are fixed and count equally; within each,
episodes are drawn with replacement, whole, with all their windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hma_jax.config import require
from hma_jax.evaluation.windows import WindowTable

PRIOR = 4.0
"""Observations that the pooled variance over seeds counts as, beside those of a point: three seeds say little."""


@dataclass(frozen=True)
class Measured:
    """A loss in nats per token of n trials at positions `x` on K axes, by episode."""

    axes: tuple[str, ...]  # K names, such as "trunk parameters"
    x: np.ndarray  # [n, K]
    run: np.ndarray  # [n], str: points of one run (a trial and its decay branches) share their seeds' luck
    seed: np.ndarray  # [n], int
    trial: tuple[str, ...]  # n ids
    sums: np.ndarray  # [n, e]: added up over the windows of an episode
    windows: np.ndarray  # [e]: how many an episode has
    dataset: np.ndarray  # [e], int: of which dataset it is

    def __post_init__(self):
        n, e = self.sums.shape
        lengths = {len(self.x), len(self.run), len(self.seed), len(self.trial)}
        require(lengths == {n}, f"{n} trials, but their columns have {sorted(lengths)}")
        require(len(self.windows) == len(self.dataset) == e, f"{e} episodes, but their columns differ in length")

    @property
    def value(self) -> np.ndarray:
        """[n]: mean over windows, then over datasets."""
        return self._means(np.ones((1, self.sums.shape[1])))[0]

    @property
    def points(self) -> np.ndarray:
        """[n]: the number of the distinct position that each trial stands at."""
        return np.unique(self.x, axis=0, return_inverse=True)[1].ravel()

    def only(self, chosen: np.ndarray) -> Measured:
        """The trials where `chosen` [n] holds."""
        ids = tuple(t for t, c in zip(self.trial, chosen, strict=True) if c)
        columns = (self.x[chosen], self.run[chosen], self.seed[chosen], ids, self.sums[chosen])
        return Measured(self.axes, *columns, self.windows, self.dataset)

    def seeds_per_point(self) -> int:
        """The least that any position has."""
        return int(np.bincount(self.points).min())

    def noise(self) -> np.ndarray:
        """[n]: standard deviation over seeds of the logarithm of a trial's loss, at its position.

        The variance of a position is joined with that of all, which counts as PRIOR more observations. nan where no
        position has two seeds.
        """
        logs, points = np.log(self.value), self.points
        count = np.bincount(points)
        mean = np.bincount(points, logs) / count
        squares = np.bincount(points, (logs - mean[points]) ** 2)
        freedom = count - 1
        if not freedom.sum():
            return np.full(len(logs), np.nan)
        pooled = squares.sum() / freedom.sum()
        return np.sqrt((squares + PRIOR * pooled) / (freedom + PRIOR))[points]

    def draw(self, draws: int, rng: np.random.Generator, episodes: bool = True) -> np.ndarray:
        """[draws, n]: the losses with seeds, and unless told otherwise episodes, drawn with replacement.

        Seeds are drawn per run, so that branches of a run move together. A seed's deviation from the mean of its
        position is taken sqrt(m / (m - 1)) times for m seeds: otherwise the spread of few would come out too small.
        With a single seed nothing is known of the spread, and the loss keeps it.
        """
        weight_Re = self._draw_episodes(draws, rng) if episodes else np.ones((1, self.sums.shape[1]))
        means_Rn = np.broadcast_to(self._means(weight_Re), (draws, len(self.x)))
        found = means_Rn.copy()
        for run in np.unique(self.run):
            seeds = np.unique(self.seed[self.run == run])
            if len(seeds) < 2:
                continue
            chosen_RS = rng.integers(0, len(seeds), (draws, len(seeds)))
            for point in np.unique(self.points[self.run == run]):
                at = np.flatnonzero((self.run == run) & (self.points == point))
                own = means_Rn[:, at]
                centre, m = own.mean(1, keepdims=True), len(at)
                if m < 2:
                    continue
                if m == len(seeds):  # in the order of `seeds`
                    at, own = at[np.argsort(self.seed[at])], own[:, np.argsort(self.seed[at])]
                    chosen = chosen_RS
                else:  # some seeds of this point are missing: those that there are, on their own
                    chosen = rng.integers(0, m, (draws, m))
                found[:, at] = centre + np.sqrt(m / (m - 1)) * (np.take_along_axis(own, chosen, 1) - centre)
        return found

    def _draw_episodes(self, draws: int, rng: np.random.Generator) -> np.ndarray:
        """[draws, e]: how often each episode is drawn."""
        weight = np.zeros((draws, len(self.dataset)))
        for dataset in np.unique(self.dataset):
            at = np.flatnonzero(self.dataset == dataset)
            weight[:, at] = rng.multinomial(len(at), np.full(len(at), 1 / len(at)), draws)
        return weight

    def _means(self, weight_Re: np.ndarray) -> np.ndarray:
        """[R, n]: mean over datasets of the mean over windows, episodes counting `weight_Re` times."""
        datasets = np.unique(self.dataset)
        total = np.zeros((len(weight_Re), len(self.sums)))
        for dataset in datasets:
            at = self.dataset == dataset
            total += (weight_Re[:, at] @ self.sums[:, at].T) / (weight_Re[:, at] @ self.windows[at])[:, None]
        return total / len(datasets)


@dataclass(frozen=True)
class Place:
    """Where a trial stands."""

    trial: str
    run: str
    seed: int
    x: tuple[float, ...]


def measure(
    axes: Sequence[str],
    places: Sequence[Place],
    tables: Mapping[str, WindowTable],
    scope: Sequence[str],
    metric: str = "cross_entropy",
) -> Measured:
    """The losses of trials at `places` from their `tables` of windows, over the datasets of `scope`.

    Raises ConfigError unless all were judged on the same windows.
    """
    require(len(places) > 0, "no finished trial to measure")
    first = _windows_of(tables[places[0].trial], scope)
    keys = list(zip(first.dataset.tolist(), first.episode.tolist(), strict=True))
    names = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    which = np.array([names[key] for key in keys])
    datasets = {name: i for i, name in enumerate(first.datasets)}
    require(metric in first.metrics, f"trial {places[0].trial} has no {metric} of its windows")
    sums = []
    for place in places:
        own = _windows_of(tables[place.trial], scope).matched_to(first)
        sums.append(np.bincount(which, own.metrics[metric], len(names)))
    return Measured(
        tuple(axes),
        np.array([place.x for place in places], float).reshape(len(places), len(axes)),
        np.array([place.run for place in places]),
        np.array([place.seed for place in places]),
        tuple(place.trial for place in places),
        np.array(sums),
        np.bincount(which, minlength=len(names)).astype(float),
        np.array([datasets[name] for name, _ in names]),
    )


def _windows_of(table: WindowTable, scope: Sequence[str]) -> WindowTable:
    return table.rows(np.flatnonzero(np.isin(table.dataset, list(scope))))
