"""The processor's cores, counted without JAX: children of the runner ask before they import it."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores of the processor that this process may use. On CPUs XLA shares sums out among them: the last digits of
    results depend on how many they are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
