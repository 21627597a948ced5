"""Possible true success rates of policies, given the rates that were measured at a limited number of starts.

Measured rates have the noise of their starts: it lowers correlations and disorders ranks, and resampled starts have
this noise twice. Here true rates are drawn instead, from their posterior distribution: a policy's rates in the two
worlds are normally distributed over policies, with unknown mean, spreads and correlation, and measured with normal
noise. What a start adds equally to all policies of a world says nothing about how they differ, and is left out.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import stdtr

SPREADS = np.geomspace(0.01, 0.5, 20)
"""Standard deviations over policies that a world may have, all of [0, 0.5] equally likely; rates cannot have more."""

CORRELATIONS = np.sin(np.linspace(-0.5, 0.5, 31) * np.pi)
"""Correlations between the rates in the two worlds, evenly spaced in their angle. All angles are equally likely, except
the ends."""

PERFECT = 0.1
"""Probability of each end, where the rates of one world are a linear function of the other's. If it were below 2.5 %,
intervals of uninformative rates would not reach the ends."""


def noise_of_starts(true_PM: np.ndarray, learned_PM: np.ndarray) -> np.ndarray:
    """[P, 2, 2] covariance of both rates' errors, from successes bool [P, M] at the same M starts."""
    outcomes_2PM = np.stack([true_PM, learned_PM]).astype(float)
    policies, starts = true_PM.shape
    sd_2P = _sd(outcomes_2PM.sum(-1), starts)
    apart_2PM = outcomes_2PM - outcomes_2PM.mean(-1, keepdims=True)
    covariance = np.einsum("apm,bqm->abpq", apart_2PM, apart_2PM) / (starts - 1) / starts
    scale = np.einsum("ap,bq->abpq", sd_2P, sd_2P)
    # Pooled over policies; the covariance between different policies comes from what starts have in common.
    own, other = (
        (covariance * which).sum((2, 3)) / (scale * which).sum((2, 3))
        for which in (np.eye(policies), 1 - np.eye(policies))
    )
    kept = np.maximum([1 - other[0, 0], 1 - other[1, 1]], 0.05)  # with few policies `other` has errors of its own
    # Even if all episodes are alike, one more need not be.
    most = (1 - 1 / outcomes_2PM[0].size) * np.sqrt(kept.prod())
    return _covariance(sd_2P, kept, float(np.clip((own - other)[0, 1], -most, most)))


def noise_of_counts(successes_P: np.ndarray, episodes_P: np.ndarray, learned_PM: np.ndarray) -> np.ndarray:
    """The same if the true rates come from other starts, with `successes_P` in `episodes_P` episodes."""
    noise = noise_of_starts(learned_PM, learned_PM)
    noise[:, 0, 0] = _sd(successes_P, episodes_P) ** 2
    noise[:, 0, 1] = noise[:, 1, 0] = 0.0
    return noise


def has_one_apart(measured_P2: np.ndarray, noise_P22: np.ndarray) -> bool:
    """Whether a policy is so far from the others, in either world, that true rates are not normally distributed.

    Grubbs' test (1969, "Procedures for Detecting Outlying Observations in Samples", Technometrics 11) at 5 % for both
    worlds, adapted to rates whose noise may differ between policies.
    """
    policies, noise_P2 = len(measured_P2), np.diagonal(noise_P22, axis1=1, axis2=2)
    if policies < 3:
        return False
    t_2 = np.zeros(2)
    for p in range(policies):
        others, noise_2 = np.delete(measured_P2, p, 0), np.delete(noise_P2, p, 0).mean(0)
        variance_2 = np.maximum(others.var(0, ddof=1), noise_2)  # near 0 and 1 measured rates may all be equal
        error_2 = np.sqrt(variance_2 * (1 + 1 / len(others)) + np.maximum(noise_P2[p] - noise_2, 0))
        t_2 = np.maximum(t_2, np.abs(measured_P2[p] - others.mean(0)) / error_2)
    return bool((stdtr(policies - 2, -t_2) < 0.05 / (2 * 2 * policies)).any())


def draw_rates(measured_P2: np.ndarray, noise_P22: np.ndarray, draws: int) -> np.ndarray:
    """[draws, P, 2] true rates, up to a constant for each world. They may be slightly below 0 or above 1."""
    rng = np.random.default_rng(1)
    factor_G22, log_prior_G = _grid()
    precision_GP22 = _inverse(np.einsum("gik,gjk->gij", factor_G22, factor_G22)[:, None] + noise_P22)
    # The mean has a flat prior.
    sum_G22, weighed_G2 = precision_GP22.sum(1), np.einsum("gpij,pj->gi", precision_GP22, measured_P2)
    spread_G22 = _inverse(sum_G22)
    misfit_G = np.einsum("pi,gpij,pj->g", measured_P2, precision_GP22, measured_P2) - np.einsum(
        "gi,gij,gj->g", weighed_G2, spread_G22, weighed_G2
    )
    log_G = log_prior_G + 0.5 * (np.log(_det(precision_GP22)).sum(1) - np.log(_det(sum_G22)) - misfit_G)
    weights_G = np.exp(log_G - log_G.max())
    g = rng.choice(len(weights_G), size=draws, p=weights_G / weights_G.sum())
    mean_n2 = np.einsum("nij,nj->ni", spread_G22[g], weighed_G2[g]) + _normal(rng, spread_G22[g])
    # A policy's rates are mean + factor @ u with u standard normal, which holds where the factor is singular, too.
    seen_nP22 = np.einsum("nji,pjk->npik", factor_G22[g], _inverse(noise_P22))
    spread_nP22 = _inverse(np.eye(2) + seen_nP22 @ factor_G22[g][:, None])
    apart_nP2 = measured_P2 - mean_n2[:, None]
    u_nP2 = np.einsum("npij,npjk,npk->npi", spread_nP22, seen_nP22, apart_nP2) + _normal(rng, spread_nP22)
    return mean_n2[:, None] + np.einsum("nij,npj->npi", factor_G22[g], u_nP2)


@cache
def _grid() -> tuple[np.ndarray, np.ndarray]:
    """(factors [G, 2, 2] of the covariances over policies, log of their prior [G])."""
    true_G, learned_G, r_G = (x.ravel() for x in np.meshgrid(SPREADS, SPREADS, CORRELATIONS, indexing="ij"))
    factor_G22 = np.zeros((len(r_G), 2, 2))
    factor_G22[:, 0, 0], factor_G22[:, 1, 0] = true_G, learned_G * r_G
    factor_G22[:, 1, 1] = learned_G * np.sqrt(1 - r_G**2)
    of_r_G = np.where(np.abs(r_G) == 1, PERFECT, (1 - 2 * PERFECT) / (len(CORRELATIONS) - 2))
    return factor_G22, np.log(of_r_G * true_G * learned_G)  # spreads are evenly spaced in their logarithm


def _sd(successes: np.ndarray, episodes: np.ndarray | int) -> np.ndarray:
    """Standard error of a rate, computed with an extra half success and half failure, so that it is not zero at 0 and
    1."""
    rate = (successes + 0.5) / (episodes + 1)
    return np.sqrt(rate * (1 - rate) / episodes)


def _covariance(sd_2P: np.ndarray, kept: np.ndarray, shared: float) -> np.ndarray:
    """[P, 2, 2] of standard errors, the parts of their squares that are `kept`, and the correlation of both."""
    noise_P22 = np.einsum("ap,bp->pab", sd_2P, sd_2P)
    return noise_P22 * np.array([[kept[0], shared], [shared, kept[1]]])


def _normal(rng: np.random.Generator, covariance: np.ndarray) -> np.ndarray:
    factor = np.linalg.cholesky(covariance)
    return np.einsum("...ij,...j->...i", factor, rng.standard_normal(covariance.shape[:-1]))


def _det(matrices: np.ndarray) -> np.ndarray:
    return matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Inverses of many [2, 2] matrices, faster than np.linalg.inv."""
    adjugate = matrices[..., ::-1, ::-1].swapaxes(-1, -2) * np.array([[1, -1], [-1, 1]])
    return adjugate / _det(matrices)[..., None, None]
