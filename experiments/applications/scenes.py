"""True frames of the suite's robots, labelled with the positions of tools and objects, objects by colour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import positions_of, render_frames
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.spec import IMAGE_SIZE, EmbodimentSpec
from data_pipelines.suite.visible import object_colours, visible_shares

VISIBLE_SHARE = 0.25
"""Share of a tool or object that must be in view for it to count as visible."""

OUT_OF_VIEW = 9.0
"""Coordinate, in world units, at which an object is out of view."""


class Points(NamedTuple):
    """P points in F frames: tools, then objects by colour of the palette.

    position float32 [F, P, 2] in pixels (column, row), 0 where there is none; share float32 [F, P] of it in view.
    """

    position: np.ndarray
    share: np.ndarray

    @property
    def visible(self) -> np.ndarray:
        return self.share >= VISIBLE_SHARE

    @property
    def absent(self) -> np.ndarray:
        """bool [F, P]: colours that no object has; these points have no position."""
        return ~self.position.any(-1)


class Scenes(NamedTuple):
    """F true frames and their points."""

    images: np.ndarray  # uint8 [F, H, W, 3]
    points: Points


def point_names(spec: EmbodimentSpec) -> tuple[str, ...]:
    tools = tuple(f"tool_{m}" for m in range(len(spec.body.tools)))
    return (*tools, *(f"colour_{c}" for c in range(len(spec.palette.objects))))


def points_of(spec: EmbodimentSpec, seed_F: np.ndarray, q: np.ndarray, objects: np.ndarray) -> Points:
    """The points of F frames, given configurations q [F, C], objects [F, K, 2] and the seeds [F] of their episodes."""
    tools, frames = len(spec.body.tools), np.arange(len(q))
    true = positions_of(spec, q, objects)
    position = np.zeros((len(q), len(point_names(spec)), 2), np.float32)
    share = np.zeros(position.shape[:2], np.float32)
    position[:, :tools] = true[:, :tools]
    share[:, :tools] = ((true[:, :tools] > -0.5) & (true[:, :tools] < IMAGE_SIZE - 0.5)).all(-1)
    seeds, which = np.unique(seed_F, return_inverse=True)
    colours, seen = object_colours(spec, seeds)[which], visible_shares(spec, q, objects)
    for k in range(objects.shape[1]):
        position[frames, tools + colours[:, k]] = true[:, tools + k]
        share[frames, tools + colours[:, k]] = seen[:, k]
    return Points(position, share)


def draw_scenes(
    spec: EmbodimentSpec, split: str, episodes: int, per_episode: int, seed: int, missing: float = 0.0
) -> Scenes:
    """Frames at random moments of a split's first episodes; each object is missing with probability `missing`."""
    seeds = episode_seeds(spec, episodes, 0, split)
    rollout, rng = simulate(spec, seeds), np.random.default_rng([seed, *map(ord, spec.name)])
    episode = np.repeat(np.arange(episodes), per_episode)
    moments = (rng.random(len(episode)) * rollout.lengths[episode]).astype(int)
    hidden = rng.random((len(episode), rollout.objects.shape[2])) < missing
    q, objects = (
        rollout.q[episode, moments],
        np.where(hidden[..., None], OUT_OF_VIEW, rollout.objects[episode, moments]),
    )
    points = points_of(spec, seeds[episode], q, objects)
    images = render_frames(spec, draw_appearance(spec, seeds), rollout.goals, q, objects, episode)
    return Scenes(images, points)
