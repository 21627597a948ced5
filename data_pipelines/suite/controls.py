"""What an action means: from a goal configuration to action values, and from these to joint velocities.

A control covers some action dimensions and some joints. The scripted behaviour uses `encode`, which turns a goal
configuration into action values in the robot's own unit. The physics uses `rate`: the joint velocities that an
action commands; it does not see the goal. A robot's action is the concatenation of its controls' actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from data_pipelines.suite.bodies import Body

SERVO_SECONDS = 0.12
"""Time constant with which position-controlled joints approach their target."""

LOOKAHEAD_SECONDS = 0.35
"""An absolute target lies at most this far ahead (or one native step, if that is longer)."""

SETTLE_SECONDS = 0.3
"""A goal is approached at the speed that would reach it in this time (or in one native step)."""

HEADROOM = 1.3
"""Joints move at most this many times faster than the scripted behaviour asks for."""


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

    def rate(self, body: Body, q: np.ndarray, action: np.ndarray, dt: float) -> np.ndarray:
        """[n, joints] velocities that `action` [n, dim] asks for; dt is the native step."""
        j = list(self.joints)
        most = HEADROOM * body.speed[j]
        return np.clip((self.offset + self.unit * action - q[:, j]) / SERVO_SECONDS, -most, most)


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
        rate = (goal[:, j] - q[:, j]) / max(dt, SETTLE_SECONDS)
        rate = np.clip(rate, -body.speed[j], body.speed[j])
        return rate / self.unit * (dt if self.convention == "delta" else 1.0)

    def rate(self, body: Body, q: np.ndarray, action: np.ndarray, dt: float) -> np.ndarray:
        most = HEADROOM * body.speed[list(self.joints)]
        return np.clip(action * self.unit / (dt if self.convention == "delta" else 1.0), -most, most)


@dataclass(frozen=True)
class Drive:
    """Body-frame driving of a base: joints `base`, `base` + 1, `base` + 2 are x, y, heading.

    wheels: left and right wheel speed, `track` apart. holonomic: forward and sideways speed in
    `unit`, turn rate in `turn_unit`.
    """

    key: str
    style: Literal["wheels", "holonomic"] = "holonomic"
    unit: float = 1.0
    turn_unit: float = 1.0
    track: float = 0.5
    base: int = 0
    convention: Literal["velocity"] = "velocity"

    @property
    def dim(self) -> int:
        return 3 if self.style == "holonomic" else 2

    @property
    def joints(self) -> tuple[int, ...]:
        return self.base, self.base + 1, self.base + 2

    def encode(self, body: Body, q: np.ndarray, goal: np.ndarray, dt: float) -> np.ndarray:
        mine = slice(self.base, self.base + 3)
        q, goal, (speed, _, turn) = q[:, mine], goal[:, mine], body.speed[mine]
        away = goal[:, :2] - q[:, :2]
        if self.style == "holonomic":
            cos, sin = np.cos(q[:, 2]), np.sin(q[:, 2])
            rate = limit(away / max(dt, SETTLE_SECONDS), speed)
            error = wrap(goal[:, 2] - q[:, 2])
            spin = np.clip(error / max(dt, SETTLE_SECONDS), -turn, turn)
            forward = cos * rate[:, 0] + sin * rate[:, 1]
            sideways = -sin * rate[:, 0] + cos * rate[:, 1]
            return np.stack([forward / self.unit, sideways / self.unit, spin / self.turn_unit], 1)
        error = wrap(np.arctan2(away[:, 1], away[:, 0]) - q[:, 2])
        gear = np.where(np.cos(error) < -0.3, -1.0, 1.0)  # what lies behind is reached backwards
        error = wrap(error + np.where(gear < 0, np.pi, 0.0))
        pace = np.minimum(np.linalg.norm(away, axis=1) / max(dt, SETTLE_SECONDS), speed)
        pace = pace * np.maximum(np.cos(error), 0.15) * gear
        side = np.clip(error / max(dt, SETTLE_SECONDS), -turn, turn) * self.track / 2
        return np.stack([pace - side, pace + side], 1) / self.unit

    def rate(self, body: Body, q: np.ndarray, action: np.ndarray, dt: float) -> np.ndarray:
        mine = slice(self.base, self.base + 3)
        most, heading = HEADROOM * body.speed[mine], q[:, self.base + 2]
        if self.style == "wheels":
            left, right = action[:, 0] * self.unit, action[:, 1] * self.unit
            along, across, spin = (left + right) / 2, np.zeros(len(q)), (right - left) / self.track
        else:
            along, across, spin = action[:, 0] * self.unit, action[:, 1] * self.unit, action[:, 2] * self.turn_unit
        cos, sin = np.cos(heading), np.sin(heading)
        velocity = limit(np.stack([cos * along - sin * across, sin * along + cos * across], 1), most[0])
        return np.concatenate([velocity, np.clip(spin, -most[2], most[2])[:, None]], 1)


Control = JointTarget | JointRate | Drive
