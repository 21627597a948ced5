"""What an action means: how a target becomes numbers, and how numbers move a body.

A control covers some action dimensions. `encode` is used by the scripted behaviour: it
turns a wish (a configuration to go to) into action values in the embodiment's own unit.
`advance` is the physics: it moves the configuration by what the action says, and sees
nothing but the action. An embodiment's action is the concatenation of its controls'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from data_pipelines.suite.bodies import Body

SERVO_SECONDS = 0.07
"""Time constant with which position-controlled joints approach their target."""

LOOKAHEAD_SECONDS = 0.2
"""An absolute target lies at most this far ahead (or one native step, if that is longer)."""


def limit(vector: np.ndarray, length: float) -> np.ndarray:
    """`vector` [..., 2] shortened to at most `length`."""
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.minimum(1.0, length / np.maximum(norm, 1e-9))


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class JointTarget:
    """Absolute joint targets: q* = offset + unit * action."""

    key: str
    joints: tuple[int, ...]
    unit: float = 1.0
    offset: float = 0.0
    convention: Literal["absolute"] = "absolute"

    @property
    def dim(self) -> int:
        return len(self.joints)

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        """[n, dim] actions that bring q [n, C] nearer to goal [n, C] in one step of dt seconds."""
        j = list(self.joints)
        ahead = body.speed[j] * max(dt, LOOKAHEAD_SECONDS)
        target = q[:, j] + np.clip(goal[:, j] - q[:, j], -ahead, ahead)
        return (np.clip(target, body.low[j], body.high[j]) - self.offset) / self.unit

    def advance(self, body: Body, q: np.ndarray, action: np.ndarray, h: float, dt: float) -> None:
        """Moves q in place by h seconds of this action; dt is the native step."""
        j = list(self.joints)
        error = self.offset + self.unit * action - q[:, j]
        # Slack over the nominal speed, so that the target of a slow step is always reached.
        most = 1.6 * body.speed[j] * h
        q[:, j] += np.clip(error * (1 - np.exp(-h / SERVO_SECONDS)), -most, most)


@dataclass(frozen=True)
class JointRate:
    """Joint velocities (unit per second), or per-step deltas when `convention` is "delta"."""

    key: str
    joints: tuple[int, ...]
    unit: float = 1.0
    convention: Literal["velocity", "delta"] = "velocity"

    @property
    def dim(self) -> int:
        return len(self.joints)

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        j = list(self.joints)
        rate = (goal[:, j] - q[:, j]) / max(dt, 0.15)
        rate = np.clip(rate, -body.speed[j], body.speed[j])
        return rate / self.unit * (dt if self.convention == "delta" else 1.0)

    def advance(self, body: Body, q: np.ndarray, action: np.ndarray, h: float, dt: float) -> None:
        rate = action * self.unit / (dt if self.convention == "delta" else 1.0)
        q[:, list(self.joints)] += rate * h


@dataclass(frozen=True)
class ToolTarget:
    """Absolute Cartesian target of one tool: point = offset + unit * action."""

    key: str
    tool: int = 0
    unit: float = 1.0
    offset: float = 0.0
    speed: float = 1.0
    convention: Literal["absolute"] = "absolute"
    dim: int = 2

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        here = body.tool_points(body.pose(q))[:, self.tool]
        there = body.tool_points(body.pose(goal))[:, self.tool]
        target = here + limit(there - here, self.speed * max(dt, LOOKAHEAD_SECONDS))
        return (target - self.offset) / self.unit

    def advance(self, body: Body, q: np.ndarray, action: np.ndarray, h: float, dt: float) -> None:
        pose = body.pose(q)
        error = self.offset + self.unit * action - body.tool_points(pose)[:, self.tool]
        move = limit(error * (1 - np.exp(-h / SERVO_SECONDS)), 1.6 * self.speed * h)
        q += body.solve(pose, move, self.tool)


@dataclass(frozen=True)
class ToolRate:
    """Cartesian velocity of one tool (unit per second), or its per-step delta."""

    key: str
    tool: int = 0
    unit: float = 1.0
    speed: float = 0.9
    convention: Literal["velocity", "delta"] = "delta"
    dim: int = 2

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        here = body.tool_points(body.pose(q))[:, self.tool]
        there = body.tool_points(body.pose(goal))[:, self.tool]
        rate = limit((there - here) / max(dt, 0.15), self.speed)
        return rate / self.unit * (dt if self.convention == "delta" else 1.0)

    def advance(self, body: Body, q: np.ndarray, action: np.ndarray, h: float, dt: float) -> None:
        rate = action * self.unit / (dt if self.convention == "delta" else 1.0)
        q += body.solve(body.pose(q), rate * h, self.tool)


@dataclass(frozen=True)
class Drive:
    """Body-frame driving of a base: joints `base`, `base` + 1, `base` + 2 are x, y, heading.

    twist: forward speed, turn rate. wheels: left and right wheel speed. car: forward speed,
    steering angle. holonomic: forward and sideways speed, turn rate.
    """

    key: str
    style: Literal["twist", "wheels", "car", "holonomic"] = "twist"
    unit: float = 1.0
    turn_unit: float = 1.0
    track: float = 0.4  # wheel distance, or the car's wheel base
    base: int = 0
    convention: Literal["velocity"] = "velocity"

    @property
    def dim(self) -> int:
        return 3 if self.style == "holonomic" else 2

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        mine = slice(self.base, self.base + 3)
        q, goal, (speed, _, turn) = q[:, mine], goal[:, mine], body.speed[mine]
        away = goal[:, :2] - q[:, :2]
        distance = np.linalg.norm(away, axis=1)
        if self.style == "holonomic":
            cos, sin = np.cos(q[:, 2]), np.sin(q[:, 2])
            rate = limit(away / max(dt, 0.2), speed)
            error = wrap(goal[:, 2] - q[:, 2])
            spin = np.clip(error / max(dt, 0.2), -turn, turn)
            forward = cos * rate[:, 0] + sin * rate[:, 1]
            sideways = -sin * rate[:, 0] + cos * rate[:, 1]
            return np.stack([forward / self.unit, sideways / self.unit, spin / self.turn_unit], 1)
        error = np.arctan2(away[:, 1], away[:, 0]) - q[:, 2]
        reverse = np.cos(error) < -0.4 if self.style == "car" else np.zeros(len(q), bool)
        error = wrap(error + np.where(reverse, np.pi, 0.0))
        gear = np.where(reverse, -1.0, 1.0)
        pace = np.minimum(distance / max(dt, 0.2), speed) * np.maximum(np.cos(error), 0.15) * gear
        if self.style == "car":
            steer = np.clip(1.4 * error * gear, -0.7, 0.7)
            return np.stack([pace / self.unit, steer / self.turn_unit], 1)
        spin = np.clip(error / max(dt, 0.25), -turn, turn)
        if self.style == "twist":
            return np.stack([pace / self.unit, spin / self.turn_unit], 1)
        side = spin * self.track / 2
        return np.stack([pace - side, pace + side], 1) / self.unit

    def advance(self, body: Body, q: np.ndarray, action: np.ndarray, h: float, dt: float) -> None:
        q, sideways = q[:, self.base : self.base + 3], 0.0  # a view: moves in place
        if self.style == "wheels":
            left, right = action[:, 0] * self.unit, action[:, 1] * self.unit
            pace, spin = (left + right) / 2, (right - left) / self.track
        else:
            pace, spin = action[:, 0] * self.unit, action[:, -1] * self.turn_unit
        if self.style == "car":
            spin = pace * np.tan(np.clip(spin, -1.2, 1.2)) / self.track
        if self.style == "holonomic":
            sideways = action[:, 1] * self.unit
        middle = q[:, 2] + spin * h / 2
        q[:, 0] += (np.cos(middle) * pace - np.sin(middle) * sideways) * h
        q[:, 1] += (np.sin(middle) * pace + np.cos(middle) * sideways) * h
        q[:, 2] += spin * h


Control = JointTarget | JointRate | ToolTarget | ToolRate | Drive
