"""Visibility of objects: their colours, and the share of each that is in the image and not occluded by a link.

Computed from the shapes that `render` paints, at a few points of each object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.suite.appearance import object_order
from data_pipelines.suite.render import View
from data_pipelines.suite.spec import EmbodimentSpec

RINGS = ((0.0, 1), (0.45, 6), (0.8, 12))
"""Sample points of each object: (share of its radius, number of points)."""


def object_colours(spec: EmbodimentSpec, seeds: Sequence[int]) -> np.ndarray:
    """int [n, K]: which of the palette's object colours each object has in the episodes with these seeds."""
    return np.array([object_order(spec, seed) for seed in seeds])[:, : spec.task.objects]


def visible_shares(spec: EmbodimentSpec, q: np.ndarray, objects: np.ndarray) -> np.ndarray:
    """float [F, K]: the visible share of each object in configurations q [F, C] with objects [F, K, 2]."""
    view, pose = View(spec.camera), spec.body.pose(q)
    turns = [np.arange(count) * 2 * np.pi / count for _, count in RINGS]
    circle = [share * np.stack([np.cos(t), np.sin(t)], -1) for (share, _), t in zip(RINGS, turns, strict=True)]
    points = objects[:, :, None] + spec.task.size * np.concatenate(circle)  # [F, K, n, 2]
    pixel = view.points(points)
    seen = ((pixel > -0.5) & (pixel < view.size - 0.5)).all(-1)
    for i, link in enumerate(spec.body.links):
        if link.radius <= 0:
            continue
        middle = (pose.origin[:, i] + pose.tip[:, i])[:, None, None] / 2
        away, angle = points - middle, pose.angle[:, i][:, None, None]
        along = away[..., 0] * np.cos(angle) + away[..., 1] * np.sin(angle)
        across = away[..., 1] * np.cos(angle) - away[..., 0] * np.sin(angle)
        beyond = [np.maximum(np.abs(x) - half, 0) for x, half in ((along, link.length / 2), (across, link.half_width))]
        seen &= np.hypot(*beyond) > link.radius
    return seen.mean(-1)
