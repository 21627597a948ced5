"""The processor's cores, counted without JAX: child processes of the runner ask for them before they import JAX."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """The number of processor cores that this process may use. On CPUs XLA divides sums among them, so the last digits
    of results depend on their number."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
