"""Tasks: goals and objects, when an episode succeeds, and where a tool should go next.

A task is scripted only one step deep ("get behind the object", "push it to the mark"); this, imprecise control and
exploration produce real failures as well as successes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Scene(Protocol):
    """What a task sees of n episodes."""

    goals: np.ndarray  # [n, M, 2], one for each tool
    objects: np.ndarray  # [n, K, 2]
    held: np.ndarray  # [n, M]: the object in each tool's grip, or -1
    hand: np.ndarray  # [n]: the tool that does the task
    tools: np.ndarray  # [n, M, 2]
    tool_radius: float
    grasp: float  # how near a gripper must be to an object to hold it


@dataclass(frozen=True)
class Reach:
    """All tools at their goals at the same moment. Objects are in the way."""

    radius: float = 0.25
    objects: int = 1
    size: float = 0.26
    carries: bool = False
    marks_object: bool = False  # the mark is where a tool should be, not an object

    def plan(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """Where the tools should go [n, M, 2], and gripper openings [n, M] (nan: no opinion)."""
        return scene.goals, np.full(scene.goals.shape[:2], np.nan)

    def done(self, scene: Scene) -> np.ndarray:
        """bool [n]: the goal is reached now."""
        return (np.linalg.norm(scene.tools - scene.goals, axis=-1) < self.radius).all(1)


@dataclass(frozen=True)
class Push:
    """Object 0 pushed onto the mark by the tool that is nearest at the start."""

    radius: float = 0.28
    objects: int = 1
    size: float = 0.26
    carries: bool = False
    marks_object: bool = True

    def plan(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        target = scene.tools.copy()
        rows = np.arange(len(target))
        tool, thing, goal = target[rows, scene.hand], scene.objects[:, 0], scene.goals[:, 0]
        way = goal - thing
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        side = np.stack([-way[:, 1], way[:, 0]], 1)
        gap = self.size + scene.tool_radius
        offset = tool - thing
        along, across = (offset * way).sum(1), (offset * side).sum(1)
        ready = (along < -0.5 * gap) & (np.abs(across) < 0.7 * self.size)
        beside = along > -0.3 * gap  # in front of the object: go round it first
        sign = np.where(across >= 0, 1.0, -1.0)[:, None]
        behind = thing - way * (gap + 0.05)
        around = thing - way * 0.5 * gap + side * sign * (gap + 0.12)
        aim = np.where(beside[:, None], around, behind)
        target[rows, scene.hand] = np.where(ready[:, None], thing + way * 0.15 - side * across[:, None], aim)
        return target, np.full(target.shape[:2], np.nan)

    def done(self, scene: Scene) -> np.ndarray:
        return np.linalg.norm(scene.objects[:, 0] - scene.goals[:, 0], axis=-1) < self.radius


@dataclass(frozen=True)
class Carry:
    """Object 0 gripped by the tool that is nearest at the start, and brought to the mark."""

    radius: float = 0.28
    objects: int = 1
    size: float = 0.22
    carries: bool = True
    marks_object: bool = True

    def plan(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        target = scene.tools.copy()
        opening = np.full(target.shape[:2], np.nan)
        rows = np.arange(len(target))
        tool, thing, goal = target[rows, scene.hand], scene.objects[:, 0], scene.goals[:, 0]
        held = scene.held[rows, scene.hand] == 0
        near = np.linalg.norm(tool - thing, axis=1) < 0.6 * scene.grasp
        target[rows, scene.hand] = np.where(held[:, None], goal, thing)
        opening[rows, scene.hand] = np.where(held | near, 0.0, 1.0)
        return target, opening

    def done(self, scene: Scene) -> np.ndarray:
        return np.linalg.norm(scene.objects[:, 0] - scene.goals[:, 0], axis=-1) < self.radius


Task = Reach | Push | Carry
