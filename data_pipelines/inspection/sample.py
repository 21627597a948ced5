"""Example episodes of a dataset, small enough to keep dozens in memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

HEIGHT = 240
"""Larger frames are shrunk to this height in pixels."""


@dataclass(frozen=True)
class ExampleEpisode:
    """An episode for a person to look at: a few frames of every camera, and its actions as recorded."""

    index: int  # its number among all episodes that the files should have
    steps: int
    success: bool | None
    instruction: str
    times: tuple[int, ...]  # step of each frame
    frames: dict[str, list[np.ndarray]]  # camera -> uint8 [H, W, 3] each
    actions: dict[str, np.ndarray]  # field -> [N, A]


def shrink(frame: np.ndarray) -> np.ndarray:
    """The frame, no higher than HEIGHT."""
    if frame.shape[0] <= HEIGHT:
        return frame
    width = max(round(frame.shape[1] * HEIGHT / frame.shape[0]), 1)
    return np.asarray(Image.fromarray(frame).resize((width, HEIGHT), Image.Resampling.BOX))
