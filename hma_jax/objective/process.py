"""Noising processes: the cosine process of training, and the steps of it that a sampler visits.

Tables are float64 numpy, made while a program is traced; nothing here is computed on a device.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hma_jax.config import SamplerConfig, require


@dataclass(frozen=True, eq=False)  # compared and hashed by identity: a static argument
class Process:
    """Tables of one noising process, one entry per step; index 0 is the cleanest.

    x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) eps. The posterior q(x_{t-1} | x_t, x0) has mean
    posterior_x0 * x0 + posterior_xt * x_t.
    """

    betas: np.ndarray
    log_betas: np.ndarray
    alphas_cumprod: np.ndarray  # abar
    alphas_cumprod_prev: np.ndarray  # abar one step cleaner; 1 at index 0
    clean_from_xt: np.ndarray  # x0 = clean_from_xt * x_t - clean_from_eps * eps
    clean_from_eps: np.ndarray
    posterior_x0: np.ndarray
    posterior_xt: np.ndarray
    posterior_log_variance_clipped: np.ndarray  # the variance at index 0 is 0: index 1 stands in
    timestep_map: np.ndarray  # int: the step of the original process

    @property
    def steps(self) -> int:
        return len(self.betas)

    @property
    def half_log_snr(self) -> np.ndarray:
        """log(sqrt(abar) / sqrt(1 - abar)), which falls with the step: DPM-Solver's lambda, half the log of the
        signal-to-noise ratio abar / (1 - abar)."""
        return 0.5 * np.log(self.alphas_cumprod / (1.0 - self.alphas_cumprod))

    def noise_over_signal(self, cap: float) -> np.ndarray:
        """(1 - abar) / abar, at most `cap`. The squared error of the noise times (1 - abar) / abar is that of the clean
        vector."""
        return np.minimum(1.0 / self.alphas_cumprod - 1.0, cap)


def _from_betas(betas: np.ndarray, timestep_map: np.ndarray) -> Process:
    abar = np.cumprod(1.0 - betas)
    abar_prev = np.append(1.0, abar[:-1])
    variance = betas * (1.0 - abar_prev) / (1.0 - abar)
    return Process(
        betas=betas,
        log_betas=np.log(betas),
        alphas_cumprod=abar,
        alphas_cumprod_prev=abar_prev,
        clean_from_xt=np.sqrt(1.0 / abar),
        clean_from_eps=np.sqrt(1.0 / abar - 1.0),
        posterior_x0=betas * np.sqrt(abar_prev) / (1.0 - abar),
        posterior_xt=(1.0 - abar_prev) * np.sqrt(1.0 - betas) / (1.0 - abar),
        posterior_log_variance_clipped=np.log(np.append(variance[1], variance[1:])),
        timestep_map=timestep_map,
    )


@functools.cache
def make_process(steps: int) -> Process:
    """The cosine process: abar(u) = cos^2(pi/2 (u + 0.008) / 1.008), betas at most 0.999."""
    require(steps >= 2, f"a noising process needs at least 2 steps, got {steps}")

    def abar(u: float) -> float:
        return math.cos((u + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - abar((i + 1) / steps) / abar(i / steps), 0.999) for i in range(steps)]
    return _from_betas(np.array(betas), np.arange(steps))


def _require_count(process: Process, count: int) -> None:
    require(
        2 <= count <= process.steps,
        f"a sampler cannot take {count} of the {process.steps} steps of the noising process; set sampler.steps "
        f"between 2 and {process.steps}",
    )


@functools.cache
def respace(process: Process, count: int) -> Process:
    """The process that visits `count` steps of `process`, evenly spaced from first to last.

    Positions are accumulated in floating point and then rounded, as released, so that ties are rounded the same way.
    """
    _require_count(process, count)
    stride = (process.steps - 1) / (count - 1)
    position, chosen = 0.0, []
    for _ in range(count):
        chosen.append(round(position))
        position += stride
    return _visit(process, chosen)


def _visit(process: Process, chosen: Sequence[int]) -> Process:
    """The process that visits only the steps `chosen` of `process`, which are in ascending order."""
    abar = process.alphas_cumprod[chosen]
    return _from_betas(1.0 - abar / np.append(1.0, abar[:-1]), process.timestep_map[chosen])


# --- DPM-Solver++ ----------------------------------------------------------------------------


FIRST_HALF_LOG_SNR = -4.0
"""Where `dpm++` starts: the signal's amplitude is 1/55 of the noise's there, so that pure noise can stand for it. At
the last step of the process it is 1/20,000: there the predicted clean vector is the network's error times 20,000,
limited by the clip."""


@functools.cache
def respace_by_half_log_snr(process: Process, count: int) -> Process:
    """The process that visits `count` steps of `process`, evenly spaced in half the log signal-to-noise ratio.

    From FIRST_HALF_LOG_SNR to the cleanest step. In a short process, where the spacing asks for the same step twice,
    neighbouring steps are taken.
    """
    _require_count(process, count)
    wanted = np.linspace(process.half_log_snr[0], FIRST_HALF_LOG_SNR, count)
    nearest = np.abs(process.half_log_snr - wanted[:, None]).argmin(axis=1)
    order = np.arange(count)
    apart = np.maximum.accumulate(nearest - order) + order  # every step once
    return _visit(process, np.minimum(apart, process.steps - count + order))


def sampling_process(process: Process, sampler: SamplerConfig) -> Process:
    """The process with the steps of `process` that `sampler` visits. Each costs one evaluation of the network."""
    if sampler.kind == "dpm++":
        return respace_by_half_log_snr(process, sampler.steps)
    return respace(process, sampler.steps)


class Multistep(NamedTuple):
    """One step of DPM-Solver++(2M): x <- keep * x + mix * (x0 + lead * (x0 - x0 of the step before)) + fresh * noise.

    One entry per step of the process, as in `Process`.
    """

    keep: np.ndarray
    mix: np.ndarray
    lead: np.ndarray
    fresh: np.ndarray


@functools.cache
def multistep(process: Process, eta: float) -> Multistep:
    """The second-order coefficients for prediction of the clean vector (Lu et al. 2022).

    `eta` 0 solves the ordinary differential equation, 1 the stochastic one of ancestral sampling; values between solve
    that with `eta` times its diffusion rate. The first step has no earlier one, and the last goes to zero noise, which
    has no finite logarithm: both are of first order, and the last returns its clean vector.
    """
    cleaner = process.alphas_cumprod_prev
    stride = process.half_log_snr[:-1] - process.half_log_snr[1:]  # from index i + 1 to i
    forgotten = np.append(0.0, np.exp(-eta * stride))
    decay = np.append(0.0, np.exp(-(1.0 + eta) * stride))
    lead = np.zeros(process.steps)
    lead[1:-1] = stride[:-1] / (2.0 * stride[1:])
    return Multistep(
        keep=np.sqrt((1.0 - cleaner) / (1.0 - process.alphas_cumprod)) * forgotten,
        mix=np.sqrt(cleaner) * (1.0 - decay),
        lead=lead,
        fresh=np.sqrt((1.0 - cleaner) * (1.0 - forgotten**2)),
    )
