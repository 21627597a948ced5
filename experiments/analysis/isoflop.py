"""Which size is best for a budget of training FLOPs: minima of isoFLOP curves, and the power law through them.

Each size's run gives its loss at several budgets, by its decay branches; between them the loss is interpolated in
the logarithm (modified Akima, no further out than TOLERANCE). At one budget the loss over log N is fitted by a
parabola, whose minimum is N_opt; then N_opt = k C^a over budgets. A budget at which the smallest or the largest size
has the lowest loss, or whose parabola has no minimum between them, is refused: the best size may lie beyond. A parabola
through losses that only flatten also has a minimum. If sizes are off the parabola by more than seeds scatter, that is
reported: the error of its minimum is then larger than the bootstrap's.

The parabola is a choice that no bootstrap accounts for. So the exponent is given a second time, from the parabola
through only the best size and its two neighbours. The exponent is reported as doubtful if bootstraps, whose draws both
share, distinguish the two (the one from three sizes is so much noisier that it often lies outside the other's interval
by chance), and if one size has the lowest loss at every budget: then only the form says that the best size grows or
shrinks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc  # not scipy.stats, which takes most of a second to import

from experiments.analysis.fits import DRAWS, LACK_OF_FIT_P, OPEN_SHARE, Coefficient, interval
from experiments.analysis.measured import Measurements
from experiments.terminal.words import counted

TOLERANCE = 0.1
"""Share of a budget by which a size's first or last measured FLOPs may miss it."""

MIN_SIZES, MIN_BUDGETS = 4, 3
"""Least number of sizes at one budget (one more than a parabola has parameters), and of budgets with a minimum for the
power law."""

BUDGETS = 4
"""At most: no more than were measured."""

NEIGHBOURS = 2
"""Number of sizes on either side of the best one to which the parabola is fitted: further out the curve is not a
parabola."""


@dataclass(frozen=True)
class Budget:
    """The sizes at one budget of training FLOPs."""

    flops: float
    sizes: np.ndarray  # [m]
    loss: np.ndarray  # [m], mean over seeds
    parabola: np.ndarray | None = None  # of log loss over log size - `centre`, highest power first
    centre: float = 0.0
    best: Coefficient | None = None  # N_opt
    near: Coefficient | None = None  # N_opt from only the best size and its two neighbours, if there is a best one
    refused: str = ""
    doubt: str = ""
    misfit: str = ""  # whether sizes are off the parabola by more than seeds scatter

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is doubtful about the best size."""
        return tuple(filter(None, (self.doubt, self.misfit)))

    @property
    def remarks(self) -> str:
        """Why there is no best size, or what is doubtful about it."""
        return self.refused or "; ".join(self.doubts)

    @property
    def lowest(self) -> float:
        """The size with the lowest measured loss."""
        return float(self.sizes[np.argmin(self.loss)])

    def at(self, sizes: np.ndarray) -> np.ndarray:
        """The parabola's loss."""
        return np.exp(np.polyval(self.parabola, np.log(sizes) - self.centre))


@dataclass(frozen=True)
class IsoFlop:
    """N_opt = k C^a through the best sizes, and the same (`near`) through those from the best size and its neighbours
    only."""

    budgets: tuple[Budget, ...] = ()
    exponent: Coefficient | None = None  # a
    scale: float = float("nan")  # k
    near: Coefficient | None = None  # a, if there is an exponent
    near_scale: float = float("nan")  # k
    apart: Coefficient | None = None  # a minus that of three sizes, draw by draw, if there is an exponent
    refused: str = ""

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is doubtful about the exponent, besides doubts about the best size of a single budget."""
        a, apart, found = self.exponent, self.apart, []
        if a is None:
            return ()
        if not apart.low <= 0 <= apart.high:
            found.append(
                f"the three sizes around each best one alone give {self.near.value:.2g}, another exponent by more than the "
                "bootstraps scatter"
            )
        lowest = {b.lowest for b in self.budgets if len(b.sizes) >= MIN_SIZES}
        if len(lowest) == 1 and not a.low <= 0 <= a.high:
            size = f"{lowest.pop():,.0f} trunk parameters"
            changes = "grows" if a.value > 0 else "shrinks"
            found.append(
                f"{size} have the lowest loss at every budget: the form of the fit alone says that the best size {changes}"
            )
        return tuple(found)


def fit_isoflop(measured: Measurements, budgets: np.ndarray | None = None, draws: int = DRAWS) -> IsoFlop:
    """Fits the best size for each budget, and its power law, to losses over (size N, training FLOPs C). Without
    `budgets`, BUDGETS of them are evenly spread in log C over the range in which at least MIN_SIZES sizes were
    measured."""
    sizes = np.unique(measured.x[:, 0])
    if len(sizes) < MIN_SIZES:
        return IsoFlop(refused=f"{len(sizes)} sizes; a minimum over sizes needs at least {MIN_SIZES}")
    values = np.concatenate([measured.value[None], measured.draw(draws, np.random.default_rng(0))])  # [1 + R, n]
    lines = [_Line(measured, values, size) for size in sizes]
    budgets = _common_budgets(lines) if budgets is None else np.asarray(budgets, float)
    if not len(budgets):
        return IsoFlop(refused=f"no budget that {MIN_SIZES} sizes were trained for")
    fitted = [_fit_budget(lines, flops) for flops in budgets]
    found, minima = [b for b, _ in fitted], [(b.flops, m) for b, m in fitted if b.best]  # m [2, 1 + R]
    if len(minima) < MIN_BUDGETS:
        why = f"{len(minima)} of {len(found)} budgets have a minimum; the exponent needs at least {MIN_BUDGETS}"
        return IsoFlop(tuple(found), refused=why)
    flops, optima = np.log([f for f, _ in minima]), np.stack([m for _, m in minima], 1)  # [b], [2, b, 1 + R]
    (slopes, scale), (near_slopes, near_scale) = (_law(flops, of_form) for of_form in optima)
    exponent, near, apart = (
        Coefficient(name, float(a[0]), *map(float, interval(a[1:])))
        for name, a in (("a", slopes), ("a of three sizes", near_slopes), ("difference", slopes - near_slopes))
    )
    return IsoFlop(tuple(found), exponent, scale, near, near_scale, apart)


def _law(flops: np.ndarray, optima: np.ndarray) -> tuple[np.ndarray, float]:
    """(a [1 + R], k of the values) of N_opt = k C^a, from log C [b] and log N_opt [b, 1 + R]."""
    slope, level = np.polyfit(flops - flops.mean(), optima, 1)
    return slope, float(np.exp(level[0] - slope[0] * flops.mean()))


class _Line:
    """log loss of one size over log C, for the values and for every draw, averaged over seeds."""

    def __init__(self, measured: Measurements, values: np.ndarray, size: float):
        own = measured.x[:, 0] == size
        self.size, flops = size, measured.x[own, 1]
        self.flops, which = np.unique(flops, return_inverse=True)
        self._seeds = np.bincount(which)
        means = np.stack([values[:, own][:, which == i].mean(1) for i in range(len(self.flops))])  # [c, 1 + R]
        self.logs = np.log(means)

    def covers(self, flops: float) -> bool:
        return self.flops[0] * (1 - TOLERANCE) <= flops <= self.flops[-1] * (1 + TOLERANCE)

    def seeds_near(self, flops: float) -> int:
        """Number of seeds at the measured budget nearest to `flops`."""
        return int(self._seeds[np.argmin(np.abs(np.log(self.flops / flops)))])

    def at(self, flops: float) -> np.ndarray:
        """[1 + R] log loss."""
        inside = np.clip(flops, self.flops[0], self.flops[-1])
        if len(self.flops) == 1 or inside in self.flops:
            return self.logs[np.searchsorted(self.flops, inside)]
        from scipy.interpolate import Akima1DInterpolator  # most reports need none, and it is slow to import

        return Akima1DInterpolator(np.log(self.flops), self.logs, axis=0, method="makima")(np.log(inside))


def _common_budgets(lines: list[_Line]) -> np.ndarray:
    """Budgets evenly spread in log C between the lowest and the highest that enough sizes cover: as many as were
    measured, up to BUDGETS. Budgets within TOLERANCE of each other count as one: steps are whole numbers, so sizes miss
    a budget slightly."""
    ends = np.unique(np.concatenate([line.flops for line in lines]))
    covered = [f for f in ends if sum(line.covers(f) for line in lines) >= MIN_SIZES]
    if not covered:
        return np.array([])
    distinct = covered[:1]
    for flops in covered:
        if flops > distinct[-1] * (1 + TOLERANCE):
            distinct.append(flops)
    budgets = np.geomspace(covered[0], covered[-1], min(BUDGETS, len(distinct)))
    return np.array([b for b in budgets if sum(line.covers(b) for line in lines) >= MIN_SIZES])


def _fit_budget(lines: list[_Line], flops: float) -> tuple[Budget, np.ndarray]:
    """(the budget, log N_opt [2, 1 + R] of the parabola and of the three sizes around the best)."""
    covering = [line for line in lines if line.covers(flops)]
    sizes = np.array([line.size for line in covering])
    logs = np.stack([line.at(flops) for line in covering]) if covering else np.zeros((0, 1))
    loss = np.exp(logs[:, 0])
    if len(sizes) < MIN_SIZES:
        few = f"{counted(len(sizes), 'size')}; at least {MIN_SIZES} are needed"
        return Budget(flops, sizes, loss, refused=few), np.zeros((2, 0))
    least, at_end = int(np.argmin(loss)), np.isin(np.argmin(logs, 0), (0, len(sizes) - 1))  # at_end [1 + R]
    first = max(min(least - NEIGHBOURS, len(sizes) - 2 * NEIGHBOURS - 1), 0)
    near = slice(first, first + 2 * NEIGHBOURS + 1)
    sizes, loss, logs = sizes[near], loss[near], logs[near]
    x = np.log(sizes)
    parabolas = np.polyfit(x - x.mean(), logs, 2)  # [3, 1 + R]
    opens_up = parabolas[0] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        lowest = np.where(opens_up, -parabolas[1] / (2 * parabolas[0]), np.nan) + x.mean()
    # A draw that opens downwards is lowest at the end to which it falls.
    falling = np.where(logs[0] < logs[-1], x[0], x[-1])
    lowest = np.where(opens_up, np.clip(lowest, x[0], x[-1]), falling)
    both = np.stack([lowest, _lowest_of_three(x, logs)])
    common = dict(parabola=parabolas[:, 0], centre=float(x.mean()))
    if at_end[0] or not opens_up[0] or lowest[0] in (x[0], x[-1]):
        refused = "the parabola has no minimum between the sizes"
        if at_end[0]:
            refused = f"the {'largest' if least else 'smallest'} size is best: the minimum may lie beyond"
        return Budget(flops, sizes, loss, **common, refused=refused), both
    part = float((at_end[1:] | np.isin(lowest[1:], (x[0], x[-1]))).mean())
    doubt = f"in {part:.0%} of the bootstraps the best size is at an end" if part > OPEN_SHARE else ""
    best, around = (
        Coefficient(name, *(float(np.exp(v)) for v in (of_form[0], *interval(of_form[1:]))))
        for name, of_form in zip(("N_opt", "N_opt of three sizes"), both, strict=True)
    )
    misfit = _misfit(logs - np.vander(x - x.mean(), 3) @ parabolas, [line.seeds_near(flops) for line in covering[near]])
    return Budget(flops, sizes, loss, **common, best=best, near=around, doubt=doubt, misfit=misfit), both


def _lowest_of_three(x: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """[1 + R]: the minimum, between the neighbours, of the parabola through the least of `logs` [m, 1 + R] and its two
    neighbours over `x` [m]; if the least is at an end, that end."""
    least, draw = np.argmin(logs, 0), np.arange(logs.shape[1])
    middle = np.clip(least, 1, len(x) - 2)
    (x0, x1, x2), (y0, y1, y2) = ([v(middle + i) for i in (-1, 0, 1)] for v in (x.take, lambda i: logs[i, draw]))
    left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    with np.errstate(divide="ignore", invalid="ignore"):  # if three are on a line, the least is at an end
        lowest = (x0 + x1) / 2 - left * (x2 - x0) / (2 * (right - left))
    return np.where(least == middle, lowest, x[least])


def _misfit(residuals: np.ndarray, seeds: Sequence[int]) -> str:
    """Says that sizes are off the parabola; empty if they are not. `residuals` [m, 1 + R] of log losses: column 0 is
    from the measured values, the others are from the draws, which scatter around it as means over `seeds` [m] do. An F
    test of lack of fit, as in `fits` for a power law."""
    scatter = float(((residuals[:, 1:] - residuals[:, :1]) ** 2).sum(0).mean())
    if min(seeds) < 2 or scatter == 0:
        return ""
    ratio = float((residuals[:, 0] ** 2).sum()) / scatter
    chance = float(fdtrc(len(seeds) - 3, sum(seeds) - len(seeds), ratio))
    if chance >= LACK_OF_FIT_P:
        return ""
    return f"sizes lie off the parabola by more than seeds scatter (F = {ratio:.1f}, p = {chance:.2g})"
