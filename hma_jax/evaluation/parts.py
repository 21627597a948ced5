"""The batches of an evaluation that have been measured, kept on disk until the evaluation ends.

An evaluation of hours that is stopped, for example by a job's time limit, continues after them.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hma_jax.config import ConfigError
from hma_jax.config.json import stable_hash
from hma_jax.evaluation.images import Sample
from hma_jax.evaluation.windows import COLUMNS, WindowTable
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.runtime.files import write_file

SAVE_SECONDS = 60.0
"""The longest time until results are on disk. An evaluation that takes less time writes nothing here."""

STAMP = "made_from"

log = logging.getLogger(__name__)


class Part(NamedTuple):
    """The results of one batch."""

    windows: WindowTable
    samples: tuple[tuple[str, Sample], ...]  # (dataset, window to look at)


class Parts:
    """The parts of one evaluation in `directory`. Use `remove` once its result is written.

    `made_from()` returns what its numbers depend on, as JSON types. Parts that were made from something else are
    removed.
    """

    def __init__(self, directory: Path, made_from: Callable[[], Any], every: float = SAVE_SECONDS):
        self.directory, self._every, self._made_from = directory, every, made_from
        self._waiting, self._saved = dict[int, Part](), time.monotonic()
        if directory.exists() and self._stamp() != stable_hash(made_from()):
            self.remove()

    def read(self, n: int) -> Part | None:
        """The results of batch n; None if they were not kept, or if their file is damaged, which is logged."""
        path = self.directory / f"{n}.npz"
        if not path.exists():
            return None
        try:
            with reading_arrays(path, "it is measured again") as arrays:
                return _from_arrays(dict(arrays))
        except ConfigError as error:
            log.warning("%s", error)
            return None

    def add(self, n: int, part: Part) -> None:
        """Keeps the results of batch n. Raises OSError if they cannot be written."""
        self._waiting[n] = part
        if time.monotonic() - self._saved >= self._every:
            self.directory.mkdir(parents=True, exist_ok=True)
            write_file(self.directory / STAMP, stable_hash(self._made_from()))
            for number, waiting in self._waiting.items():
                write_arrays(self.directory / f"{number}.npz", _to_arrays(waiting))
            self._waiting, self._saved = {}, time.monotonic()

    def remove(self) -> None:
        shutil.rmtree(self.directory, ignore_errors=True)

    def _stamp(self) -> str:
        try:
            return (self.directory / STAMP).read_text()
        except OSError:
            return ""


def _to_arrays(part: Part) -> dict[str, np.ndarray]:
    arrays = {name: getattr(part.windows, name) for name in COLUMNS}
    arrays |= {f"metrics/{name}": values for name, values in part.windows.metrics.items()}
    for i, (dataset, sample) in enumerate(part.samples):
        arrays[f"samples/{i}/dataset"] = np.asarray(dataset)
        arrays |= {f"samples/{i}/{name}": x for name, x in sample._asdict().items() if x is not None}
    return arrays


def _from_arrays(arrays: dict[str, np.ndarray]) -> Part:
    metrics = {name.removeprefix("metrics/"): x for name, x in arrays.items() if name.startswith("metrics/")}
    samples = []
    while (start := f"samples/{len(samples)}/") + "dataset" in arrays:
        fields = {name: arrays.get(start + name) for name in Sample._fields}
        samples.append((str(arrays[start + "dataset"]), Sample(**fields)))
    return Part(WindowTable(*(arrays[name] for name in COLUMNS), metrics), tuple(samples))
