"""Robot bodies: planar kinematic trees, and builders for the usual ones.

Owns geometry only: links, joints, where things are in a configuration, and which small change of configuration moves a
tool somewhere. `controls` says what an action means, `tasks` what a robot tries to do. World units: the cameras see
about [-1, 1] x [-1, 1].

Array letters of this package: n episodes (or frames), C configuration entries, L links,
M tools, K objects, A action values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

DAMPING = 0.02
"""Ridge of the damped least-squares inverse, world units squared."""


@dataclass(frozen=True)
class Joint:
    """One entry of the configuration: limits, and top speed in its unit per second."""

    low: float
    high: float
    speed: float
    wraps: bool = False  # a heading: kept within its limits by turning over, not by stopping


@dataclass(frozen=True)
class Link:
    """A rigid piece. It starts at its parent's tip, moved by its joint, and is `length` long.

    `turn` links rotate by gain * q; `slide_x` and `slide_y` shift their origin by q along an
    axis of the parent's frame. Links that share a joint move together (fingers of a gripper).
    """

    parent: int = -1  # -1: the world
    joint: int = -1  # -1: fixed
    kind: Literal["turn", "slide_x", "slide_y"] = "turn"
    gain: float = 1.0
    angle: float = 0.0  # at q = 0, relative to the parent, radians
    mount: tuple[float, float] = (0.0, 0.0)  # relative to the parent's tip, in its frame
    length: float = 0.0
    radius: float = 0.0  # 0: invisible
    half_width: float = 0.0  # > 0: a box with corners rounded by `radius`
    paint: int = 0  # index into the embodiment's robot colours
    touches: bool = False  # pushes objects


class Pose(NamedTuple):
    """Where every link is: origin [n, L, 2], angle [n, L] in radians, tip [n, L, 2]."""

    origin: np.ndarray
    angle: np.ndarray
    tip: np.ndarray


@dataclass(frozen=True)
class Body:
    """A kinematic tree; parents precede children. `tools` are links whose tip is steered.

    `grips[m]` is the joint that opens tool m's gripper (0 closed, 1 open), or -1.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    tools: tuple[int, ...]
    grips: tuple[int, ...]

    @property
    def size(self) -> int:
        """C: entries of the configuration."""
        return len(self.joints)

    @cached_property
    def low(self) -> np.ndarray:
        return np.array([j.low for j in self.joints])

    @cached_property
    def high(self) -> np.ndarray:
        return np.array([j.high for j in self.joints])

    @cached_property
    def speed(self) -> np.ndarray:
        return np.array([j.speed for j in self.joints])

    @cached_property
    def _stops(self) -> tuple[np.ndarray, np.ndarray]:
        """The limits at which joints stop, infinite for those that wrap."""
        wraps = np.array([j.wraps for j in self.joints])
        return np.where(wraps, -np.inf, self.low), np.where(wraps, np.inf, self.high)

    def beyond(self, q: np.ndarray) -> np.ndarray:
        """bool [n, C]: entries of q past a limit at which they stop."""
        low, high = self._stops
        return (q < low) | (q > high)

    def confine(self, q: np.ndarray) -> None:
        """Brings q [n, C] back within the limits, in place."""
        np.clip(q, *self._stops, out=q)
        for c, joint in enumerate(self.joints):
            if joint.wraps:
                q[:, c] = joint.low + (q[:, c] - joint.low) % (joint.high - joint.low)

    @cached_property
    def _chains(self) -> tuple[tuple[int, ...], ...]:
        """For each tool, its moving ancestors (link indices)."""
        chains = []
        for tool in self.tools:
            chain, link = [], tool
            while link >= 0:
                if self.links[link].joint >= 0:
                    chain.append(link)
                link = self.links[link].parent
            chains.append(tuple(chain))
        return tuple(chains)

    @cached_property
    def tool_joints(self) -> np.ndarray:
        """bool [M, C]: the joints that move each tool."""
        mask = np.zeros((len(self.tools), self.size), bool)
        for m, chain in enumerate(self._chains):
            mask[m, [self.links[i].joint for i in chain]] = True
        return mask

    def random(self, rng: np.random.Generator, n: int, spread: float = 1.0) -> np.ndarray:
        """[n, C] configurations, uniform over the middle `spread` of the limits."""
        unit = 0.5 + spread * (rng.random((n, self.size)) - 0.5)
        return self.low + unit * (self.high - self.low)

    def pose(self, q: np.ndarray) -> Pose:
        """Forward kinematics of configurations q [n, C]."""
        n, count = len(q), len(self.links)
        # The last row, which -1 means, is the world.
        origin, tip = np.zeros((count + 1, n, 2)), np.zeros((count + 1, n, 2))
        angle, cos, sin = np.zeros((count + 1, n)), np.ones((count + 1, n)), np.zeros((count + 1, n))
        for i, link in enumerate(self.links):
            p = link.parent
            x, y = link.mount
            value = link.gain * q[:, link.joint] if link.joint >= 0 else 0.0
            if link.kind == "slide_x":
                x = x + value
            elif link.kind == "slide_y":
                y = y + value
            if link.kind == "turn" and x == y == 0:
                origin[i] = tip[p]
            else:
                origin[i, :, 0] = cos[p] * x - sin[p] * y + tip[p, :, 0]
                origin[i, :, 1] = sin[p] * x + cos[p] * y + tip[p, :, 1]
            if link.kind == "turn":
                angle[i] = link.angle + angle[p] + value
            else:
                angle[i] = link.angle + angle[p]
            np.cos(angle[i], out=cos[i])
            np.sin(angle[i], out=sin[i])
            tip[i] = origin[i]
            if link.length:
                tip[i, :, 0] += link.length * cos[i]
                tip[i, :, 1] += link.length * sin[i]
        return Pose(origin[:-1].swapaxes(0, 1), angle[:-1].swapaxes(0, 1), tip[:-1].swapaxes(0, 1))

    def tool_points(self, pose: Pose) -> np.ndarray:
        """[n, M, 2]"""
        return pose.tip[:, list(self.tools)]

    def jacobian(self, pose: Pose) -> np.ndarray:
        """d tool / d q, [n, M, 2, C]."""
        result = np.zeros((len(pose.angle), len(self.tools), 2, self.size))
        for m, (tool, chain) in enumerate(zip(self.tools, self._chains, strict=True)):
            for i in chain:
                link = self.links[i]
                if link.kind == "turn":
                    arm = pose.tip[:, tool] - pose.origin[:, i]
                    step = np.stack([-arm[:, 1], arm[:, 0]], -1)
                else:
                    turn = pose.angle[:, link.parent] if link.parent >= 0 else np.zeros(len(pose.angle))
                    turn = turn + (np.pi / 2 if link.kind == "slide_y" else 0.0)
                    step = np.stack([np.cos(turn), np.sin(turn)], -1)
                result[:, m, :, link.joint] += link.gain * step
        return result

    def solve(self, pose: Pose, move: np.ndarray) -> np.ndarray:
        """Configuration change [n, C] that moves the tools by about `move` [n, M, 2].

        Damped least squares, one step: exact for small moves away from singular poses.
        """
        j = self.jacobian(pose)
        j = j.reshape(len(j), -1, self.size)
        gram = j @ j.swapaxes(1, 2) + DAMPING * np.eye(j.shape[1])
        weights = np.linalg.solve(gram, move.reshape(len(j), -1, 1))
        return (j.swapaxes(1, 2) @ weights)[..., 0]


# --- Putting bodies together -----------------------------------------------------------------


def join(*bodies: Body) -> Body:
    """Several trees side by side, as one robot: joints, tools and grips in order."""
    links, joints, tools, grips = [], [], [], []
    for b in bodies:
        base, first = len(links), len(joints)
        links += [_shift(link, base, first, -1) for link in b.links]
        joints += b.joints
        tools += [t + base for t in b.tools]
        grips += [g + first if g >= 0 else -1 for g in b.grips]
    return Body(tuple(links), tuple(joints), tuple(tools), tuple(grips))


def attach(parent: Body, *children: Body, at: int | None = None) -> Body:
    """`children` mounted on the tip of link `at` (default: the parent's last tool).

    A child's tools replace the tool they are mounted on; children without tools add none.
    """
    at = parent.tools[-1] if at is None else at
    links, joints = list(parent.links), list(parent.joints)
    tools, grips = list(parent.tools), list(parent.grips)
    for child in children:
        base, first = len(links), len(joints)
        links += [_shift(link, base, first, at) for link in child.links]
        joints += child.joints
        if child.tools and at in tools:
            del grips[tools.index(at)], tools[tools.index(at)]
        tools += [t + base for t in child.tools]
        grips += [g + first if g >= 0 else -1 for g in child.grips]
    return Body(tuple(links), tuple(joints), tuple(tools), tuple(grips))


def _shift(link: Link, base: int, first: int, root: int) -> Link:
    return replace(
        link,
        parent=link.parent + base if link.parent >= 0 else root,
        joint=link.joint + first if link.joint >= 0 else -1,
    )
