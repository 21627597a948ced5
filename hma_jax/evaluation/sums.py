"""Sums of a few numbers that are the same everywhere."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable


def add_up(values: Iterable[float]) -> float:
    """The sum, one after the other, to the same last digit everywhere: `sum` of Python 3.12 and later rounds once,
    that of 3.11 at every addition."""
    return functools.reduce(operator.add, values, 0.0)
