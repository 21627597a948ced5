"""Words of messages that several modules use."""

from __future__ import annotations

import math
from collections.abc import Sequence


def few(names: Sequence[str]) -> str:
    """The first names of a list that may be long."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def counted(n: int, thing: str) -> str:
    """'1 step', '2,000 steps'."""
    return f"{n:,} {thing}{'s' * (n != 1)}"


def in_thousands(n: int) -> str:
    """'48.0 k', '1.2 M'."""
    return f"{n / 1e6:,.1f} M" if n >= 1e6 else f"{n / 1e3:,.1f} k"


def duration(seconds: float) -> str:
    """'119 s', '2.0 min', '2.5 h', '3.0 days'."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds:.0f} s"


def number(value: float, error: float, sign: str = "") -> str:
    """`value` to two digits of its standard error, and four after the point at most; what rounds to zero has no minus.
    `sign`: "+" for one before every value."""
    digits = min(max(1 - math.floor(math.log10(error)), 0), 4)
    return f"{value:{sign}z.{digits}f}"


def plus_minus(mean: float, error: float, sign: str = "") -> str:
    """A mean with its standard error, or alone where none is known."""
    if 0 < error < math.inf:
        return f"{number(mean, error, sign)} ± {number(error, error)}"
    return f"{mean:{sign}.4g}" + (" ± 0" if error == 0 else "")
