"""How the episodes of an embodiment differ in looks: light, floor shade, object colours.

Drawn anew for every episode, so that a few trajectories do not cover the appearance of the
rest and held-out episodes look new.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.suite.spec import EmbodimentSpec

CONTRAST = 0.6
"""Colours are drawn towards mid-grey by this factor, as a real camera's are. It sets the scale
of all squared errors alike, so differences of PSNR do not depend on it."""


@dataclass(frozen=True)
class Appearance:
    """What differs between episodes: colours [n, ., 4] 0..255 and a light gradient [n, 2]."""

    floor: np.ndarray
    outside: np.ndarray
    robot: np.ndarray
    objects: np.ndarray
    goal: np.ndarray
    distractors: np.ndarray
    slope: np.ndarray


def draw_appearance(spec: EmbodimentSpec, n: int, seed: int) -> Appearance:
    """The looks of n episodes: pure in (spec, n, seed)."""
    rng = np.random.default_rng([seed, 4])
    look = spec.look
    light = rng.uniform(0.95, 1.05, (n, 1, 1)) * (1 + 0.008 * rng.standard_normal((n, 1, 3)))

    def colours(base: np.ndarray, spread: float) -> np.ndarray:
        base = np.broadcast_to(base, (n, *np.shape(base)[-2:]))
        lit = (base + spread * rng.standard_normal(base.shape)) * light
        lit = np.clip(128 + CONTRAST * (lit - 128), 8, 247)
        return np.pad(lit, ((0, 0), (0, 0), (0, 1))).astype(np.float32)

    floor = np.array([look.floor]) + look.shade * rng.standard_normal((n, 1, 1))
    things = [_hues(rng, (n, k)) for k in (spec.task.objects, look.distractors)]
    if spec.task.objects:
        goal = 0.55 * things[0][:, :1] + 0.45 * floor  # the mark has a pale shade of its object
    else:
        goal = 0.4 * np.array(look.robot[:1]) + 0.6 * floor
    return Appearance(
        floor=colours(floor, 2.0),
        outside=colours(np.array([look.outside]), 2.5),
        robot=colours(np.array(look.robot), 2.5),
        objects=colours(things[0], 2.0),
        goal=colours(goal, 1.0),
        distractors=colours(things[1] * 0.75 + 40, 2.0),
        slope=rng.uniform(-3, 3, (n, 2)).astype(np.float32),
    )


def _hues(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Strong colours [*shape, 3] from a wheel of six, all of similar brightness."""
    phase = rng.integers(6, size=(*shape, 1)) * (np.pi / 3) + np.array([0.0, 2.1, 4.2])
    return 130 + 95 * np.cos(phase)
