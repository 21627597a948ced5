"""What would have been seen under other actions: an optional column of the frozen windows, from a simulator.

Owns the file. Who can simulate fills it (`experiments.preparing.counterfactual`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from hma_jax.runtime.arrays import UNREADABLE, write_arrays

META = "made_for"


@dataclass(frozen=True)
class OtherTruth:
    """True frames of each window under the first of its `other_windows`' actions, from the prompt on."""

    manifest: str  # hash of the frozen windows
    prompt: int  # frames; the last one's chunk is the first that differs
    frames: Mapping[str, np.ndarray]  # of a dataset: uint8 [windows, T - prompt, H, W, 3], in their frozen order

    def save(self, path: Path) -> None:
        """Whole or not at all, the same bytes for the same frames."""
        meta = np.frombuffer(json.dumps({"manifest": self.manifest, "prompt": self.prompt}).encode(), np.uint8)
        write_arrays(path, {META: meta} | dict(self.frames))

    @classmethod
    def load(cls, path: Path) -> OtherTruth:
        """Raises DataError if it is missing or damaged."""
        try:
            with np.load(path) as arrays:
                frames = {name: arrays[name] for name in arrays.files}
                return cls(**json.loads(frames.pop(META).tobytes()), frames=frames)
        except UNREADABLE as error:
            raise DataError(
                f"{path}: the frames under other actions cannot be read ({error}). Remove the file and prepare the "
                "study again, with `hma tokenize` or `hma study`."
            ) from error
