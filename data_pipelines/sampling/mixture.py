"""How often each dataset is drawn: p ∝ n^(1/τ).

Owns the weights, and drops datasets without examples; draws nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.errors import DataError
from hma_jax.config import require


@dataclass(frozen=True)
class Mixture:
    """Datasets that are drawn, their probabilities, and why others were dropped."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    dropped: dict[str, str]  # name -> reason


def mixture_weights(counts: Sequence[int] | np.ndarray, tau: float) -> np.ndarray:
    """float64 probabilities ∝ counts^(1/tau) of positive `counts` (paper section 4; reference section 4.3). tau = 1 is
    proportional sampling, larger is flatter.
    """
    require(tau > 0, f"the mixture temperature tau must be positive, got {tau}")
    counts = np.asarray(counts, np.float64)
    powers = (counts / counts.sum()) ** (1.0 / tau)
    if not powers.any():  # tau is so small that even the largest weight underflows
        powers = (counts == counts.max()).astype(np.float64)
    return powers / powers.sum()


def make_mixture(counts: Mapping[str, int], tau: float, reasons: Mapping[str, str]) -> Mixture:
    """The mixture of the datasets in `counts` (name -> examples).

    Datasets without examples are left out; `reasons` say why. Raises DataError, with all the reasons, if none remains.
    """
    dropped = {n: reasons[n] for n, c in counts.items() if c == 0}
    if len(dropped) == len(counts):
        details = "; ".join(f"{name}: {why}" for name, why in dropped.items())
        raise DataError(f"no dataset can be used: {details}.")
    names = tuple(n for n in counts if n not in dropped)
    weights = mixture_weights([counts[n] for n in names], tau)
    return Mixture(names, tuple(weights.tolist()), dropped)
