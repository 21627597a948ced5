"""A profile of some steps of a run, recorded by JAX: what devices and host did, and when.

It is written in one format for XProf and TensorBoard, and in another for https://ui.perfetto.dev (docs/performance.md).
"""

from __future__ import annotations

from pathlib import Path

import jax

PROFILE = "profile"
"""Folder of a run directory."""

SETTLED = 10
"""Steps after a start that are not recorded, if there are others: in these steps buffers fill and libraries choose
programs."""


def traced_steps(count: int, start: int, steps: int) -> tuple[int, int]:
    """The first and the last of the steps that are recorded, `count` or as many as there are, in a run from step
    `start` to `steps`; (0, 0) for none."""
    if not count or start >= steps:
        return 0, 0
    first = 1 + max(min(start + SETTLED, steps - count), start)
    return first, min(first + count - 1, steps)


class StepTrace:
    """Records steps of a run: from `first` to `last`, see `traced_steps`.

    Use it as a context manager: a recording that is not finished ends with the block.
    """

    def __init__(self, directory: Path, count: int, start: int, steps: int):
        self.directory = directory
        self.first, self.last = traced_steps(count, start, steps)
        self._recording = False

    def start(self) -> None:
        """Starts recording; called before the first recorded step, when the device is idle."""
        jax.profiler.start_trace(self.directory, create_perfetto_trace=True)
        self._recording = True

    def stop(self) -> None:
        """Writes the profile; called when the last recorded step has been computed."""
        self._recording = False
        jax.profiler.stop_trace()

    def __enter__(self) -> StepTrace:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._recording:
            self.stop()
