"""Words of messages that several modules use."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from data_pipelines.loading.selection import Drawn

OF_MIXTURE = ("dataset", "trajectories", "windows", "share of draws", "passes")
"""Columns of `mixture_rows`."""


def few(names: Sequence[str]) -> str:
    """The first names of a list that may be long, as words."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def counted(n: int, thing: str) -> str:
    """'1 step', '2,000 steps'."""
    return f"{n:,} {thing}{'s' * (n != 1)}"


def in_thousands(n: int) -> str:
    """'48.0 k', '1.2 M'."""
    return f"{n / 1e6:,.1f} M" if n >= 1e6 else f"{n / 1e3:,.1f} k"


def times(passes: float) -> str:
    """How often something is seen: '12', '3.4'."""
    return f"{passes:,.{0 if passes >= 10 else 1}f}"


def mixture_rows(drawn: Mapping[str, Drawn], draws: int) -> list[list[str]]:
    """The amount of data in each dataset, and how often a training run of `draws` windows sees it."""
    return [
        [name, f"{one.trajectories:,}", f"{one.windows:,}", f"{one.share:.1%}", times(one.passes(draws))]
        for name, one in drawn.items()
    ]


def duration(seconds: float) -> str:
    """'119 s', '2.0 min', '2.5 h', '3.0 days'."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds:.0f} s"


def number(value: float, error: float, sign: str = "") -> str:
    """`value` to two digits of its standard error, and at most four after the point; a value that rounds to zero has no
    minus. `sign`: "+" to put a sign before every value."""
    digits = min(max(1 - math.floor(math.log10(error)), 0), 4)
    return f"{value:{sign}z.{digits}f}"


def plus_minus(mean: float, error: float, sign: str = "") -> str:
    """A mean with its standard error, or alone if the error is unknown."""
    if 0 < error < math.inf:
        return f"{number(mean, error, sign)} ± {number(error, error)}"
    return f"{mean:{sign}.4g}" + (" ± 0" if error == 0 else "")
