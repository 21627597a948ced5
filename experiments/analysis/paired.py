"""Checks that trials saw the same windows, so that they can be compared window by window (paired).

How hard a window is for both models then cancels (`compare`). Trials are comparable if they have the same windows
of a robot, with the same number of real frames and the same recorded images; anything else is refused.
"""

from __future__ import annotations

import numpy as np

from experiments.terminal.words import few
from hma_jax.config import ConfigError
from hma_jax.evaluation.windows import WindowTable

TRUTH = "psnr_copy"
"""A metric of the recorded images only, equal for equal windows whatever the model."""

SAME = 1e-3
"""dB by which two programs may differ on equal images."""


class NotComparable(ConfigError):
    """Two trials were judged on different windows."""


class NoNumbers(NotComparable):
    """A model has no number for a window although every sound model has one: its prediction there is not a number."""


def require_same_windows(a: WindowTable, b: WindowTable) -> list[str]:
    """The robots that both tables have, in the order of `a`.

    Raises NotComparable, naming the first window that differs, unless both saw the same windows of each.
    """
    if agree(a, b):
        return list(a.datasets)
    shared = [name for name in a.datasets if name in b.datasets]
    if not shared:
        raise NotComparable(f"no robot was evaluated in both: {few(a.datasets)} and {few(b.datasets)}")
    for robot in shared:
        try:
            of_a = a.of(robot)
            of_b = b.of(robot).aligned_to(of_a)
        except ConfigError as error:
            raise NotComparable(f"{robot}: {error}") from error
        _require_equal(of_a, of_a.frames, of_b.frames, "real frames", 0)
        if TRUTH in of_a.metrics and TRUTH in of_b.metrics:
            _require_equal(of_a, of_a.metrics[TRUTH], of_b.metrics[TRUTH], f"dB of {TRUTH}", SAME)
    return shared


def agree(a: WindowTable, b: WindowTable) -> bool:
    """Whether both saw the same windows in the same order: quicker than finding the one that differs."""
    if not a.has_windows_of(b) or not np.array_equal(a.frames, b.frames):
        return False
    both = TRUTH in a.metrics and TRUTH in b.metrics
    return not both or bool((np.abs(a.metrics[TRUTH] - b.metrics[TRUTH]) <= SAME).all())


def _require_equal(table: WindowTable, of_a: np.ndarray, of_b: np.ndarray, what: str, tolerance: float) -> None:
    """Raises NotComparable, naming the first window of `table` whose numbers differ."""
    differing = np.flatnonzero(~(np.abs(of_a - of_b) <= tolerance))
    if len(differing):
        robot, episode, start = table.names[differing[0]]
        raise NotComparable(
            f"window ({robot}, episode {episode}, frame {start}) differs between the two: {of_a[differing[0]]:g} and "
            f"{of_b[differing[0]]:g} {what} (and {len(differing) - 1} others of {robot}); compare trials that were "
            "evaluated on the same frozen windows, the same data and with the same prompt"
        )
