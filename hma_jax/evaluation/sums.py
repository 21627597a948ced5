"""Sums of a few numbers, with the same result on every Python version."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable


def add_up(values: Iterable[float]) -> float:
    """The sum, added one after the other, equal to the last digit everywhere. Python's `sum` rounds once from version
    3.12 on, and at every addition in 3.11."""
    return functools.reduce(operator.add, values, 0.0)
