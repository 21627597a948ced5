"""Scaling fits with intervals, and the conditions under which a fit is refused or doubtful.

L = E + A N^-alpha, or jointly L = E + A N^-alpha + B D^-beta, of a loss L in nats per token: the smallest loss E,
and how fast each axis brings it down. Residuals are weighted by the noise that seeds were measured to have, and
intervals are percentiles over bootstraps of seeds x episodes (`measured`).

A fit is refused, with the reason, where the points do not identify the form: fewer than four positions on an axis, a
loss that does not fall, an exponent at a bound of the search. Doubts are reported with the numbers: one seed per
point, a coefficient at its bound in many bootstraps, an axis along which no two trials differ in that axis alone,
points that lie off the curve by more than seeds scatter, an exponent that depends on the first position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc  # not scipy.stats, which takes most of a second to import

from experiments.analysis.measured import Measurements
from experiments.analysis.powerlaw import ALPHA, FLOOR, fit_draws, fit_values, predict_log

DRAWS, FIT_LEVEL = 1000, 0.90
MIN_POSITIONS = 4
"""Number of distinct positions on an axis that a power law with a constant needs: one more than its three
parameters."""

NAMES = (("A", "alpha"), ("B", "beta"))
WIDE_RATIO = 4.0
"""An exponent whose interval spans more than this factor is reported as doubtful."""

LACK_OF_FIT_P = 0.05
"""p-value of the F test below which a lack of fit is reported."""

OPEN_SHARE = 0.05
"""If more than this share of the bootstraps is at a bound, a coefficient's interval counts as open there."""


@dataclass(frozen=True)
class Coefficient:
    name: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class PowerFit:
    """A fit of `Measurements`, or why there is none (`refused`)."""

    axes: tuple[str, ...]
    trials: tuple[str, ...]
    refused: str = ""
    doubts: tuple[str, ...] = ()
    coefficients: tuple[Coefficient, ...] = ()
    residuals: np.ndarray | None = None  # [n], of log L
    noise: np.ndarray | None = None  # [n], standard deviation over seeds of log L; nan where nothing is known
    theta: np.ndarray | None = None  # [p]
    thetas: np.ndarray | None = None  # [R, p]
    centre: np.ndarray | None = None  # [K], mean of log x

    def __getitem__(self, name: str) -> Coefficient:
        return next(c for c in self.coefficients if c.name == name)

    def at(self, x: np.ndarray) -> np.ndarray:
        """L [m] at `x` [m, K]."""
        return np.exp(predict_log(self.theta, np.log(x) - self.centre))

    def all_at(self, x: np.ndarray) -> np.ndarray:
        """L [R, m] at `x` [m, K] of every bootstrap."""
        return np.exp(predict_log(self.thetas, np.log(x) - self.centre))

    def band(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """FIT_LEVEL interval [m], [m] of the curve at `x` [m, K]."""
        return interval(self.all_at(x))

    def formula(self, constant: bool = True) -> str:
        """In words: 'L = 1.5 + 98 x^-0.5'; without E if `constant` is False."""
        names = ("N", "D") if len(self.axes) == 2 else ("x",)
        powers = zip(NAMES, names, strict=False)
        terms = [f"{self[scale].value:.3g} {x}^-{self[exponent].value:.3g}" for (scale, exponent), x in powers]
        return "L = " + " + ".join([f"{self['E'].value:.3g}"] * constant + terms)


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """FIT_LEVEL interval of `values` [R, ...] over the first axis."""
    return tuple(np.quantile(values, [(1 - FIT_LEVEL) / 2, (1 + FIT_LEVEL) / 2], axis=0))


def fit_power(measured: Measurements, draws: int = DRAWS, episodes: bool = True) -> PowerFit:
    """The saturating power law of a loss over one axis or two, or the reason why there is none.

    `episodes`: whether bootstraps draw episodes too. Without this, intervals are conditional on the frozen windows, as
    needed for what is compared on the same windows.
    """
    refused = _unfit(measured)
    if refused:
        return PowerFit(measured.axes, measured.trial, refused)
    noise = measured.noise()
    weight = weight_of(noise)
    centre = np.log(measured.x).mean(0)
    z = np.log(measured.x) - centre
    values = measured.draw(draws, np.random.default_rng(0), episodes)
    theta, thetas = fit_draws(z, measured.value, values, weight)
    residuals = np.log(measured.value) - predict_log(theta, z)
    coefficients = _coefficients(theta, thetas, centre)
    refused, doubts = _verdict(measured, theta, thetas)
    wide = [c for c in coefficients if c.name in ("alpha", "beta") and c.high > WIDE_RATIO * c.low]
    if not refused:
        doubts += tuple(f"{c.name} may be anything between {c.low:.2g} and {c.high:.2g}" for c in wide)
        doubts += _inferred(measured) + _misfit(measured, residuals) + _first_position(measured, coefficients, weight)
    return PowerFit(
        measured.axes, measured.trial, refused, doubts, coefficients, residuals, noise, theta, thetas, centre
    )


def weight_of(noise: np.ndarray) -> np.ndarray:
    """Residuals count in units of the typical noise, so that the Huber threshold keeps its meaning."""
    if np.isnan(noise).any() or not (noise > 0).all():
        return np.ones(len(noise))
    return np.exp(np.log(noise).mean()) / noise


def _unfit(measured: Measurements) -> str:
    """Why no power law can be fitted; '' if one can."""
    for name, column in zip(measured.axes, measured.x.T, strict=True):
        distinct = np.unique(column)
        if len(distinct) < MIN_POSITIONS:
            return f"{len(distinct)} distinct {name}; the form has to be told from at least {MIN_POSITIONS}"
        if not (distinct > 0).all():
            return f"{name} has to be positive, got {distinct.min():g}"
    positions, least = len(np.unique(measured.points)), MIN_POSITIONS + 2 * (len(measured.axes) - 1)
    if positions < least:
        return (
            f"{positions} positions; the form over {' and '.join(measured.axes)} has to be told from at least {least}"
        )
    if not any(_lines(measured, k) for k in range(len(measured.axes))):
        return f"no two trials differ in {' or in '.join(measured.axes)} alone: what each does cannot be told apart"
    if not (measured.value > 0).all():
        return f"the loss has to be positive, got {measured.value.min():g}"
    return _rising(measured)


def _lines(measured: Measurements, k: int) -> list[np.ndarray]:
    """[n] each: the trials that differ only on axis `k`, at two or more positions. There are none if no two trials
    share a position on the other axis: for instance, at equal compute no two sizes see the same number of windows."""
    others = np.delete(measured.x, k, axis=1)
    lines = [(others == rest).all(1) for rest in np.unique(others, axis=0)]
    return [line for line in lines if len(np.unique(measured.x[line, k])) > 1]


def _rising(measured: Measurements) -> str:
    """Why no power law can be fitted if the loss does not fall from the first position of an axis to the last by more
    than seeds scatter; '' if it does."""
    logs, noise = np.log(measured.value), np.nan_to_num(measured.noise())
    for k, name in enumerate(measured.axes):
        falls, errors = [], []
        for line in _lines(measured, k):
            column = measured.x[line, k]
            first, last = column == column.min(), column == column.max()
            falls.append(logs[line][first].mean() - logs[line][last].mean())
            errors.append(math.hypot(*(noise[line][e].mean() / math.sqrt(e.sum()) for e in (first, last))))
        if not falls:
            continue  # `_inferred` says so
        fall, error = np.mean(falls), math.sqrt(np.sum(np.square(errors))) / len(errors)
        if fall <= 2 * error:
            return (
                f"the loss does not fall with {name}: from its first to its last it changes by {-100 * fall:+.1f} %, "
                f"with a standard error over seeds of {100 * error:.1f} %"
            )
    return ""


def _inferred(measured: Measurements) -> tuple[str, ...]:
    """Doubts about an axis if no two trials differ only along it: that the loss falls there is then inferred from the
    form."""
    alone = [name for k, name in enumerate(measured.axes) if not _lines(measured, k)]
    return tuple(
        f"no two trials differ in {name} alone: what it does is told by the form, not compared" for name in alone
    )


def _coefficients(theta: np.ndarray, thetas: np.ndarray, centre: np.ndarray) -> tuple[Coefficient, ...]:
    """Coefficients in units of x: A = A at the centre times exp(alpha centre)."""

    def named(t: np.ndarray) -> dict[str, np.ndarray]:
        coefficients = {"E": np.exp(t[..., 0])}
        for k, (scale, exponent) in enumerate(NAMES[: len(centre)]):
            alpha = t[..., 1 + len(centre) + k]
            coefficients |= {scale: np.exp(t[..., 1 + k] + alpha * centre[k]), exponent: alpha}
        return coefficients

    values, draws = named(theta), named(thetas)
    return tuple(Coefficient(n, float(values[n]), *map(float, interval(draws[n]))) for n in values)


def _misfit(measured: Measurements, residuals: np.ndarray) -> tuple[str, ...]:
    """A doubt if positions are off the curve by more than the seeds at a position scatter: an F test of lack of fit. It
    assumes independent trials, which branches of one run are not quite."""
    points, count = measured.points, np.bincount(measured.points)
    left, free = len(count) - 1 - 2 * len(measured.axes), measured.freedom
    mean = np.bincount(points, residuals) / count
    scatter = float(((residuals - mean[points]) ** 2).sum())
    if left < 1 or free < 2 or scatter == 0:
        return ()
    ratio = float((count * mean**2).sum()) / left / (scatter / free)
    chance = float(fdtrc(left, free, ratio))
    if chance >= LACK_OF_FIT_P:
        return ()
    doubt = f"points lie off the curve by more than seeds scatter (F = {ratio:.1f}, p = {chance:.2g})"
    return (f"{doubt}: over the whole range the loss is not of this form",)


def _first_position(
    measured: Measurements, coefficients: tuple[Coefficient, ...], weight: np.ndarray
) -> tuple[str, ...]:
    """A doubt if the exponent over one axis depends on the first position, where a power law need not hold yet."""
    x = measured.x[:, 0]
    keep = x > x.min()
    if len(measured.axes) > 1 or len(np.unique(x[keep])) < MIN_POSITIONS:
        return ()
    log_x = np.log(measured.x[keep])
    theta = fit_values(log_x - log_x.mean(0), measured.value[keep], weight[keep])
    alpha = next(c for c in coefficients if c.name == "alpha")
    if alpha.low <= theta[2] <= alpha.high:
        return ()
    return (f"without the first position alpha is {theta[2]:.2g} and E {np.exp(theta[0]):.2g}",)


def _verdict(measured: Measurements, theta: np.ndarray, thetas: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """(why the form is not identified, or '', what is doubtful)."""
    k, doubts = len(measured.axes), []
    for i, (_, name) in enumerate(NAMES[:k]):
        low, high = (np.isclose(thetas[:, 1 + k + i], bound, rtol=0, atol=1e-3) for bound in ALPHA)
        if np.isclose(theta[1 + k + i], ALPHA, rtol=0, atol=1e-3).any():
            bound = ALPHA[int(theta[1 + k + i] > 1)]
            return f"{name} is at {bound:g}, the end of what was searched: these points do not tell the form", ()
        part = float((low | high).mean())
        if part > OPEN_SHARE:
            ends = " and ".join(f"{b:g}" for b, at in zip(ALPHA, (low, high), strict=True) if at.any())
            doubts.append(f"in {part:.0%} of the bootstraps {name} is at the end of what was searched ({ends})")
    lowest = np.log(measured.value.min())
    zero = float((thetas[:, 0] < lowest + np.log(10 * FLOOR)).mean())
    if zero > OPEN_SHARE:
        doubts.append(f"in {zero:.0%} of the bootstraps E is zero: the interval of E reaches down to it")
    if measured.seeds_per_point() < 2:
        doubts.append("a point has one seed: the intervals do not hold its noise")
    elif measured.seeds_per_point() < 3:
        doubts.append("a point has two seeds only")
    return "", tuple(doubts)
