"""Counterfactual frames: what a camera would have shown under other actions, for frozen windows of simulated robots.

Owns the file; `experiments.preparing.counterfactual` simulates the frames.
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
class CounterfactualFrames:
    """True frames of each frozen window under the actions of the first window that `OtherWindows` chooses for it."""

    manifest: str  # hash of the frozen windows
    prompt: int  # number of frames that are as recorded; the last of them has the first other chunk
    frames: Mapping[str, np.ndarray]  # of a dataset: uint8 [windows, T - prompt, H, W, 3], in their frozen order

    def save(self, path: Path) -> None:
        """Writes the file atomically; equal frames give equal bytes."""
        meta = np.frombuffer(json.dumps({"manifest": self.manifest, "prompt": self.prompt}).encode(), np.uint8)
        write_arrays(path, {META: meta} | dict(self.frames))

    @classmethod
    def load(cls, path: Path) -> CounterfactualFrames:
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
