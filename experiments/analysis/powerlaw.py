"""The saturating power law L = E + sum_k A_k x_k^-alpha_k, fitted to many draws of the same points at once.

Owns the form, its gradient and the minimisation; `fits` decides what a fit means and whether it can be trusted.

The objective is sum_i huber(w_i (log L(x_i) - log y_i)) with a Huber threshold of DELTA in the logarithm, as in
Hoffmann et al. 2022, "Training Compute-Optimal Large Language Models": small residuals count as squares, large ones as
absolute values, so that one failed run does not bend the curve. Residuals use the logarithms of the parameters,

    log L = logsumexp(e, a_1 - alpha_1 z_1, ...),   z_k = log(x_k / geometric mean of x_k),

so that E and A_k are positive and the gradient is a softmax. An interval takes a thousand fits of three to five
parameters to a few points each. They are minimised side by side, by Levenberg-Marquardt steps on the reweighted squares
(w_i^2 DELTA / |residual| beyond the threshold, which lies above the Huber function and touches it, so that each
accepted step lowers the objective): a tenth of a second where a thousand calls of a general optimiser take ten.
A test compares the minima with those that scipy's L-BFGS finds.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

DELTA = 1e-3
"""Residual, in the logarithm of the loss, at which the Huber loss changes from squares to absolute values."""

ALPHA = (0.02, 4.0)
"""Bounds of exponents. At the lower one the law is a logarithm, at the upper one a step after the first point."""

FLOOR = 1e-4
"""Lowest E and A, as parts of the lowest value: below this they are effectively zero."""

START_ALPHA = (0.05, 0.15, 0.3, 0.5, 0.8, 1.3, 2.2)
START_E = (0.01, 0.4, 0.7, 0.85, 0.95, 0.99)
START_SHARE = (0.15, 0.5, 0.85)
"""Grid of starts: exponents; E as part of the lowest value; for two terms, the first term's part of what is above E."""

STEPS = 300


@dataclass(frozen=True)
class Bounds:
    low: np.ndarray  # [p]
    high: np.ndarray  # [p]


def predict_log(theta: np.ndarray, z: np.ndarray) -> np.ndarray:
    """log L of parameters [..., 1 + 2 K] = (e, a_1.., alpha_1..) at centred logarithms `z` [n, K]: [..., n]."""
    return _terms(theta, z)[1]


def _terms(theta: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(share of E and of each term in L [1 + K, ..., n], log L [..., n])."""
    n, k = z.shape
    terms = np.empty((1 + k, *theta.shape[:-1], n))
    terms[0] = theta[..., :1]
    for i in range(k):
        terms[1 + i] = theta[..., 1 + i, None] - theta[..., 1 + k + i, None] * z[:, i]
    top = terms.max(0)
    shares = np.exp(terms - top)
    total = shares.sum(0)
    return shares / total, np.log(total) + top


def huber(r: np.ndarray) -> np.ndarray:
    """r^2 / 2 within DELTA, DELTA (|r| - DELTA / 2) beyond."""
    size = np.abs(r)
    return np.where(size <= DELTA, 0.5 * r**2, DELTA * (size - 0.5 * DELTA))


def objective(theta: np.ndarray, z: np.ndarray, log_y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The objective [...] for parameters [..., p] and values [..., n]."""
    return _objective(predict_log(theta, z), log_y, weight)


def _objective(log_prediction: np.ndarray, log_y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return huber(weight * (log_prediction - log_y)).sum(-1)


def bounds_of(log_y: np.ndarray, terms: int) -> Bounds:
    """Bounds for values [..., n]: E and each A_k (at the centre) from FLOOR of the lowest to above the highest."""
    low, high = np.log(FLOOR) + log_y.min(), log_y.max() + 3.0
    return Bounds(
        np.array([low] * (1 + terms) + [ALPHA[0]] * terms), np.array([high] * (1 + terms) + [ALPHA[1]] * terms)
    )


def starts(log_y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The grid of starts for values [n]: [G, p]. The terms are made to meet the highest value above E."""
    k = z.shape[1]
    lowest, highest = np.exp(log_y.min()), np.exp(log_y.max())
    shares = [(1.0,)] if k == 1 else [(s, 1 - s) for s in START_SHARE]
    alphas = itertools.product(START_ALPHA if k == 1 else START_ALPHA[::2], repeat=k)
    grid = []
    for part, share, alpha in itertools.product(START_E, shares, alphas):
        above = highest - part * lowest
        a = [np.log(s * above) + x * column.min() for s, x, column in zip(share, alpha, z.T, strict=True)]
        grid.append([np.log(part * lowest), *a, *alpha])
    return np.array(grid)


def minimise(
    theta: np.ndarray, z: np.ndarray, log_y: np.ndarray, weight: np.ndarray, bounds: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Minimises from starts [R, p] for values [R, n], each independently: (parameters [R, p], objective [R])."""
    theta = np.clip(theta, bounds.low, bounds.high)
    shares, log_prediction = _terms(theta, z)
    best = _objective(log_prediction, log_y, weight)
    damping = np.full(len(theta), 1e-2)
    active = np.arange(len(theta))
    idle = np.zeros(len(theta), int)
    for _ in range(STEPS):
        now, y, so_far = theta[active], log_y[active], best[active]
        r = weight * (log_prediction[active] - y)
        step = _step(now, shares[:, active], r, z, weight, bounds, damping[active])
        trial = np.minimum(np.maximum(now + step, bounds.low), bounds.high)
        trial_shares, trial_prediction = _terms(trial, z)
        value = _objective(trial_prediction, y, weight)
        better = value < so_far
        small = better & (so_far - value <= 1e-9 * (so_far + DELTA**2))
        taken = active[better]
        theta[taken], best[taken] = trial[better], value[better]
        shares[:, taken], log_prediction[taken] = trial_shares[:, better], trial_prediction[better]
        damping[active] = np.clip(np.where(better, damping[active] / 5, damping[active] * 4), 1e-12, 1e12)
        idle[active] = np.where(better & ~small, 0, idle[active] + 1)
        active = active[idle[active] < 8]
        if not len(active):
            break
    return theta, best


def _step(
    theta: np.ndarray, shares: np.ndarray, r: np.ndarray, z: np.ndarray, weight: np.ndarray, bounds: Bounds,
    damping: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """A damped step on the reweighted squares, for each of [R, p]; it does not cross a bound at which a parameter is.
    `shares` [1 + K, R, n] as `_terms` has them, weighted residuals `r` [R, n]."""
    terms = len(shares)
    jacobian = np.empty((*r.shape, theta.shape[-1]))  # [R, n, p]
    for i, share in enumerate(shares):
        jacobian[..., i] = share
    for i, share in enumerate(shares[1:]):
        jacobian[..., terms + i] = -share * z[:, i]
    jacobian *= weight[:, None]
    reweighted = np.minimum(1.0, DELTA / np.maximum(np.abs(r), 1e-12))[..., None]
    gradient = ((reweighted * r[..., None]).swapaxes(1, 2) @ jacobian)[:, 0]
    blocked = ((theta <= bounds.low) & (gradient > 0)) | ((theta >= bounds.high) & (gradient < 0))
    jacobian[np.broadcast_to(blocked[:, None], jacobian.shape)] = 0.0
    damped = (jacobian * reweighted).swapaxes(1, 2) @ jacobian
    diagonal = np.einsum("rpp->rp", damped)  # a view
    diagonal += damping[:, None] * (diagonal + 1e-10 * diagonal.max(-1, keepdims=True)) + 1e-30 + blocked
    return -np.linalg.solve(damped, np.where(blocked, 0.0, gradient)[..., None])[..., 0]


def fit_values(z: np.ndarray, y: np.ndarray, weight: np.ndarray, bounds: Bounds | None = None) -> np.ndarray:
    """Parameters [p] of the values `y` [n], within `bounds` (None: those of the values)."""
    log_y = np.log(y)
    bounds = bounds or bounds_of(log_y, z.shape[1])
    grid = np.clip(starts(log_y, z), bounds.low, bounds.high)
    first = np.argsort(objective(grid, z, log_y, weight))[:40]
    candidates, values = minimise(grid[first], z, np.repeat(log_y[None], len(first), 0), weight, bounds)
    return candidates[np.argmin(values)]


def fit_draws(z: np.ndarray, y: np.ndarray, draws: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(parameters [p] of the values `y` [n], parameters [R, p] of each of the `draws` [R, n])."""
    log_y, log_draws = np.log(y), np.log(draws)
    bounds = bounds_of(np.concatenate([log_y[None], log_draws]), z.shape[1])
    grid = np.clip(starts(log_y, z), bounds.low, bounds.high)
    best = fit_values(z, y, weight, bounds)
    # Each draw from the fit of the values themselves and from the grid's best point for it.
    cost = np.stack([objective(g, z, log_draws, weight) for g in grid])  # [G, R]
    both = np.concatenate([np.repeat(best[None], len(draws), 0), grid[np.argmin(cost, 0)]])
    thetas, values = minimise(both, z, np.concatenate([log_draws, log_draws]), weight, bounds)
    own, other = np.split(thetas, 2)
    better = values[: len(draws)] <= values[len(draws) :]
    return best, np.where(better[:, None], own, other)
