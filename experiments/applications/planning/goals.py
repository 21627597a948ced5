"""What a picture is worth: how near it is to a picture of the goal."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

Cost = Callable[[np.ndarray], np.ndarray]
"""What each of B futures costs, float [B], by its frames uint8 [B, F, H, W, C]: less is better. The judgement of a
success head is another such function."""

CELLS = 16
"""Cells along a side that a picture is averaged to before it is compared: speckle does not count, places do."""


def coarse(images: np.ndarray) -> np.ndarray:
    """float32 [..., rows, columns, C] in [0, 1]: means over equal parts of uint8 [..., H, W, C], CELLS along each
    side or as many of them as divide it."""
    *lead, height, width, channels = images.shape
    rows, columns = math.gcd(height, CELLS), math.gcd(width, CELLS)
    split = images.reshape(*lead, rows, height // rows, columns, width // columns, channels)
    return split.mean((-4, -2), dtype=np.float32) / 255


def distance(images: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """float [...]: mean squared difference of coarse pictures uint8 [..., H, W, C] from one goal."""
    return ((coarse(images) - coarse(goal)) ** 2).mean((-3, -2, -1))


def to_picture(goal: np.ndarray) -> Cost:
    """The mean distance from a picture uint8 [H, W, C] over the second half of the horizon: being there early counts,
    and staying."""
    return lambda frames: distance(frames[:, frames.shape[1] // 2 :], goal).mean(1)
