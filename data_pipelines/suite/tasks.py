"""Tasks: goals and objects, when an episode succeeds, and where a tool should go next.

A task is scripted only one step deep ("get behind the object", "push it to the mark"); that,
imprecise control and exploration make failures as real as successes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from data_pipelines.suite.world import World


@dataclass(frozen=True)
class Reach:
    """All tools at their goals at the same moment. Objects, if any, are in the way."""

    radius: float = 0.2
    objects: int = 0
    size: float = 0.17
    carries: bool = False
    pushes: bool = True

    def plan(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Where the tools should go [n, M, 2], and gripper openings [n, M] (nan: no opinion)."""
        return world.goals, np.full(world.goals.shape[:2], np.nan)

    def done(self, world: World) -> np.ndarray:
        """bool [n]: the goal is reached now."""
        return (np.linalg.norm(world.tools - world.goals, axis=-1) < self.radius).all(1)


@dataclass(frozen=True)
class Push:
    """Object 0 pushed onto the mark by the tool that is nearest at the start."""

    radius: float = 0.22
    objects: int = 1
    size: float = 0.2
    carries: bool = False
    pushes: bool = True

    def plan(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        target = world.tools.copy()
        rows = np.arange(len(target))
        tool, thing, goal = target[rows, world.hand], world.objects[:, 0], world.goals[:, 0]
        way = goal - thing
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        side = np.stack([-way[:, 1], way[:, 0]], 1)
        gap = self.size + world.tool_radius
        offset = tool - thing
        along, across = (offset * way).sum(1), (offset * side).sum(1)
        ready = (along < -0.5 * gap) & (np.abs(across) < 0.7 * self.size)
        beside = along > -0.3 * gap  # in front of the object: go round it first
        sign = np.where(across >= 0, 1.0, -1.0)[:, None]
        behind = thing - way * (gap + 0.05)
        around = thing - way * 0.5 * gap + side * sign * (gap + 0.12)
        aim = np.where(beside[:, None], around, behind)
        target[rows, world.hand] = np.where(ready[:, None], thing + way * 0.15 - side * across[:, None], aim)
        return target, np.full(target.shape[:2], np.nan)

    def done(self, world: World) -> np.ndarray:
        return np.linalg.norm(world.objects[:, 0] - world.goals[:, 0], axis=-1) < self.radius


@dataclass(frozen=True)
class Carry:
    """Object 0 gripped by the tool that is nearest at the start, and brought to the mark."""

    radius: float = 0.2
    objects: int = 1
    size: float = 0.15
    carries: bool = True
    pushes: bool = False

    def plan(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        target = world.tools.copy()
        opening = np.full(target.shape[:2], np.nan)
        rows = np.arange(len(target))
        tool, thing, goal = target[rows, world.hand], world.objects[:, 0], world.goals[:, 0]
        held = world.held[rows, world.hand] == 0
        near = np.linalg.norm(tool - thing, axis=1) < 0.6 * world.grasp
        target[rows, world.hand] = np.where(held[:, None], goal, thing)
        opening[rows, world.hand] = np.where(held | near, 0.0, 1.0)
        return target, opening

    def done(self, world: World) -> np.ndarray:
        return np.linalg.norm(world.objects[:, 0] - world.goals[:, 0], axis=-1) < self.radius


Task = Reach | Push | Carry
