"""Visual variation between the episodes of a robot: light and object colours.

Drawn for every episode from its seed, so that held-out episodes look different from training ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.suite.spec import EmbodimentSpec

CONTRAST = 0.6
"""Colours are drawn towards mid-grey by this factor, as a real camera's are."""


@dataclass(frozen=True)
class Appearance:
    """What differs between episodes: colours float32 [n, ., 3] 0..255, and a gradient of the light [n, 2]."""

    floor: np.ndarray
    outside: np.ndarray
    robot: np.ndarray
    objects: np.ndarray
    goal: np.ndarray
    slope: np.ndarray


def draw_appearance(spec: EmbodimentSpec, seeds: Sequence[int]) -> Appearance:
    """The appearance of the episodes with these seeds, each a function of its own seed alone."""
    n, palette, count = len(seeds), spec.palette, spec.task.objects
    draws, lights, orders = zip(*(_begin(spec, seed) for seed in seeds), strict=True)
    light = np.array(lights)[:, None, None]
    order = np.array(orders)[:, :count]
    slope = np.array([rng.uniform(-2, 2, 2) for rng in draws], np.float32)

    def colours(base: np.ndarray) -> np.ndarray:
        base = np.broadcast_to(base, (n, *np.shape(base)[-2:]))
        return np.clip(128 + CONTRAST * (base * light - 128), 8, 247).astype(np.float32)

    floor, objects = np.array([palette.floor]), np.array(palette.objects, float)[order]
    owner = objects[:, :1] if spec.task.marks_object else np.array(palette.robot[:1])
    goal = 0.45 * owner + 0.55 * floor  # a pale shade of the colour of what belongs there
    return Appearance(
        floor=colours(floor),
        outside=colours(np.array([palette.outside])),
        robot=colours(np.array(palette.robot)),
        objects=colours(objects),
        goal=colours(goal),
        slope=slope,
    )


def object_order(spec: EmbodimentSpec, seed: int) -> np.ndarray:
    """int: which of the palette's object colours the first object of an episode has, the second one, and so on."""
    return _begin(spec, seed)[2]


def _begin(spec: EmbodimentSpec, seed: int) -> tuple[np.random.Generator, float, np.ndarray]:
    """(the generator from which the rest of an episode is drawn, its light, the order of its objects' colours)."""
    rng = np.random.default_rng([seed, 4])
    return rng, rng.uniform(0.97, 1.03), rng.permutation(len(spec.palette.objects))
