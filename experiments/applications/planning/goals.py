"""The cost of a rollout: how far its frames are from an image of the goal."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hma_jax.config import require

Cost = Callable[[np.ndarray], np.ndarray]
"""The cost of each of B rollouts, float [B], by its frames uint8 [B, F, H, W, C]: less is better. The probabilities of
a success head make another such function."""

CELLS = 16
"""Cells along a side to which an image is averaged before it is compared, so that positions count and noise does
not."""


def block_means(images: np.ndarray) -> np.ndarray:
    """float32 [..., rows, columns, C] in [0, 1]: means over equal parts of uint8 [..., H, W, C], CELLS along each
    side or as many of them as divide it."""
    *lead, height, width, channels = images.shape
    rows, columns = math.gcd(height, CELLS), math.gcd(width, CELLS)
    split = images.reshape(*lead, rows, height // rows, columns, width // columns, channels)
    return split.mean((-4, -2), dtype=np.float32) / 255


def distance(images: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """float [...]: mean squared difference of `block_means` of images uint8 [..., H, W, C] from those of the goal.

    Raises ConfigError for images of another size than the goal.
    """
    shown, wanted = (" x ".join(map(str, x.shape[-3:])) for x in (images, goal))
    require(shown == wanted, f"the image of the goal is {wanted}, but the frames are {shown}; scale it to their size")
    return ((block_means(images) - block_means(goal)) ** 2).mean((-3, -2, -1))


def goal_image_cost(goal: np.ndarray) -> Cost:
    """The mean distance from an image uint8 [H, W, C] over the second half of the horizon, which rewards arriving early
    and staying. Raises ConfigError for another kind of array; the cost raises it for frames of another size."""
    goal = np.asarray(goal)
    require(
        goal.dtype == np.uint8 and goal.ndim == 3,
        f"the image of a goal must be uint8 [H, W, C], got {goal.dtype} {list(goal.shape)}",
    )
    return lambda frames: distance(frames[:, frames.shape[1] // 2 :], goal).mean(1)
