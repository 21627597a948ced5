"""Example episodes of a dataset, small enough to keep dozens in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

HEIGHT = 240
"""Pixels: larger frames are shrunk to this height."""


@dataclass(frozen=True)
class ExampleEpisode:
    """An episode for a person to look at: a few frames of every camera, and its actions as recorded."""

    index: int  # its number among all that its files should have
    steps: int
    success: bool | None
    instruction: str
    times: tuple[int, ...]  # step of each frame
    frames: dict[str, list[np.ndarray]]  # camera -> uint8 [H, W, 3] each
    actions: dict[str, np.ndarray]  # field -> [N, A]


def shrink(frames: Mapping[str, Sequence[np.ndarray]], height: int = HEIGHT) -> dict[str, list[np.ndarray]]:
    """The frames of every camera, none higher than `height`."""
    return {camera: [_shrink(frame, height) for frame in own] for camera, own in frames.items()}


def _shrink(frame: np.ndarray, height: int) -> np.ndarray:
    if frame.shape[0] <= height:
        return frame
    width = max(round(frame.shape[1] * height / frame.shape[0]), 1)
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BOX))
