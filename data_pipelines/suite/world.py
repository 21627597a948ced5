"""The physics simulator of the suite: many episodes of one robot at once, in numpy.

Owns the state, momentum, contact and grasping; it executes actions and decides nothing. Joints take a moment to reach
the commanded velocity; objects slide, slow down by friction, collide with each other and the walls, and come to rest.
All episodes advance together but are independent: each is a function of its seed and its actions alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from data_pipelines.suite.spec import EmbodimentSpec

SUBSTEP_SECONDS = 1 / 15
"""Longest physics step: bodies move less than an object's radius in it."""

EDGE = 1.0
"""Objects stay on the floor: [-EDGE, EDGE] x [-EDGE, EDGE]."""

START_GAP = 0.02
"""Room between things at the start of an episode."""


@dataclass
class State:
    """Everything that changes in n episodes, and what distinguishes the episodes. Copies share nothing."""

    q: np.ndarray  # [n, C] configuration
    v: np.ndarray  # [n, C] its velocity
    objects: np.ndarray  # [n, K, 2]
    object_v: np.ndarray  # [n, K, 2]
    held: np.ndarray  # int [n, M]: the object in each tool's grip, or -1
    hold: np.ndarray  # [n, M, 2]: its position in the grip
    pending: np.ndarray  # [n, delay, A]: actions that were given and not executed yet
    goals: np.ndarray  # [n, M, 2]
    hand: np.ndarray  # int [n]: the tool that does the task
    seeds: np.ndarray  # int64 [n]

    def take(self, rows: np.ndarray | slice | Sequence[int]) -> State:
        """Some of the episodes, copied; rows may repeat."""
        return State(**{f.name: np.array(getattr(self, f.name)[rows]) for f in fields(self)})


class World:
    """n episodes of a robot, started from their seeds. `state` may be read, kept and put back."""

    def __init__(self, spec: EmbodimentSpec, seeds: Sequence[int]):
        body, task = spec.body, spec.task
        self.spec, self.body, self.dt = spec, body, 1.0 / spec.hz
        self.substeps = int(np.ceil(self.dt / SUBSTEP_SECONDS - 1e-9))
        self.pushers = [i for i, link in enumerate(body.links) if link.touches]
        self.tool_radius = max((body.links[i].radius for i in self.pushers), default=0.1)
        self.grasp = task.size + 0.08
        self.state = self._start(np.asarray(seeds, np.int64))

    # --- what there is, in n episodes ----------------------------------------------------------

    @property
    def state(self) -> State:
        """A copy."""
        return self._state.take(slice(None))

    @state.setter
    def state(self, state: State) -> None:
        self._state = state.take(slice(None))
        self.pose = self.body.pose(self._state.q)

    def __len__(self) -> int:
        return len(self._state.q)

    @property
    def q(self) -> np.ndarray:
        return self._state.q

    @property
    def objects(self) -> np.ndarray:
        return self._state.objects

    @property
    def goals(self) -> np.ndarray:
        return self._state.goals

    @property
    def held(self) -> np.ndarray:
        return self._state.held

    @property
    def hand(self) -> np.ndarray:
        return self._state.hand

    @property
    def tools(self) -> np.ndarray:
        """[n, M, 2]"""
        return self.body.tool_points(self.pose)

    def success(self) -> np.ndarray:
        """bool [n]: the goal is reached now."""
        return self.spec.task.done(self)

    # --- start -----------------------------------------------------------------------------------

    def _start(self, seeds: np.ndarray) -> State:
        body, task, n = self.body, self.spec.task, len(seeds)
        tools, count, dim = len(body.tools), task.objects, self.spec.action_dim
        # One generator per episode: what is drawn for it does not depend on the others.
        unit = np.array([np.random.default_rng([seed, 1]).random((2 + count, body.size)) for seed in seeds])
        draws = [body.low + (0.5 + spread * (unit[:, i] - 0.5)) * (body.high - body.low)
                 for i, spread in enumerate([0.7] + [0.85] * (1 + count))]  # fmt: skip
        points = [np.clip(body.tool_points(body.pose(q)), -0.7, 0.7) for q in draws[1:]]
        goals = points[0]
        objects = np.stack([p[:, 0] for p in points[1:]], 1)
        away = np.linalg.norm(objects[:, 0] - goals[:, 0], axis=1)
        # Mirrored, so that fewer episodes begin with the goal reached. Some still do: near the centre of the floor the
        # mirrored place is on the mark too, things are moved apart below, and in `Reach` it is tools that reach the
        # goal.
        close = away < 2.5 * task.radius
        objects[close, 0] = -objects[close, 0]
        self._state = State(
            q=draws[0], v=np.zeros((n, body.size)), objects=objects, object_v=np.zeros((n, count, 2)),
            held=np.full((n, tools), -1), hold=np.zeros((n, tools, 2)), pending=np.zeros((n, 0, dim)),
            goals=goals, hand=np.zeros(n, int), seeds=seeds,
        )  # fmt: skip
        self.pose = body.pose(draws[0])
        for _ in range(60):  # random places overlap; things that are apart do not move by themselves
            before = objects.copy()
            self._separate(self.pose.origin, self.pose.tip, 1.0, START_GAP)
            if np.array_equal(objects, before):  # where they go depends only on where they are
                break
        self._state.object_v[:] = 0
        self._state.hand = np.linalg.norm(self.tools - objects[:, :1], axis=-1).argmin(1)
        self._state.pending = np.repeat(self._idle()[:, None], self.spec.delay, 1)
        return self._state

    def _idle(self) -> np.ndarray:
        """[n, A]: the action that asks to stay."""
        q = self._state.q
        return np.concatenate([c.encode(self.body, q, q, self.dt) for c in self.spec.controls], 1)

    # --- one step --------------------------------------------------------------------------------

    def step(self, action: np.ndarray) -> None:
        """One native step under `action` [n, A]."""
        s, h = self._state, self.dt / self.substeps
        if self.spec.delay:
            queue = np.concatenate([s.pending, action[:, None]], 1)
            action, s.pending = queue[:, 0], queue[:, 1:]
        for _ in range(self.substeps):
            before = self._move_body(action, h)
            if self.spec.task.carries:
                self._grip(h)
            self._slide(h)
            self._separate(*before, h)

    def _move_body(self, action: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Moves the joints for h seconds; returns where all links began and ended before, [n, L, 2] each."""
        s, body, start = self._state, self.body, 0
        wanted = np.zeros_like(s.v)
        for control in self.spec.controls:
            part = action[:, start : start + control.dim]
            wanted[:, list(control.joints)] = control.rate(body, s.q, part, self.dt)
            start += control.dim
        # The mean over h of a velocity that approaches the wanted one exponentially.
        fade = np.exp(-h / self.spec.physics.inertia)
        gap = s.v - wanted
        s.q += (wanted + gap * (1 - fade) * self.spec.physics.inertia / h) * h
        s.v = wanted + gap * fade
        s.v[body.beyond(s.q)] = 0.0  # joints stop at their limits
        before = self.pose.origin, self.pose.tip
        body.confine(s.q)
        self.pose = body.pose(s.q)
        return before

    def _grip(self, h: float) -> None:
        """Closed grippers hold what is between their fingers; open ones let go, or throw."""
        s, tools = self._state, self.tools
        rows = np.arange(len(s.q))
        for m, joint in enumerate(self.body.grips):
            if joint < 0:
                continue
            away = s.objects - tools[:, m, None]
            distance = np.linalg.norm(away, axis=-1)
            nearest = distance.argmin(1)
            free = s.held[:, m] < 0
            grasp = (s.q[:, joint] < 0.35) & free & (distance[rows, nearest] < self.grasp)
            grasp &= ~(s.held == nearest[:, None]).any(1)  # two hands do not share
            s.held[grasp, m] = nearest[grasp]
            s.hold[grasp, m] = away[rows, nearest][grasp]
            s.held[s.q[:, joint] > 0.6, m] = -1
            has = s.held[:, m] >= 0
            s.hold[:, m] *= 0.8  # a held object settles between the fingers
            place = (tools[:, m] + s.hold[:, m])[has]
            s.object_v[rows[has], s.held[has, m]] = np.clip((place - s.objects[rows[has], s.held[has, m]]) / h, -2, 2)
            s.objects[rows[has], s.held[has, m]] = place

    def _slide(self, h: float) -> None:
        """Objects that nobody holds keep moving, slowed by friction."""
        s = self._state
        held = (s.held[:, :, None] == np.arange(s.objects.shape[1])).any(1)[..., None]
        speed = np.sqrt(_dot(s.object_v, s.object_v))
        slower = np.maximum(speed - self.spec.physics.friction * h, 0.0) / np.maximum(speed, 1e-9)
        s.objects += np.where(held, 0.0, s.object_v * (1 + slower) / 2 * h)
        s.object_v *= np.where(held, 1.0, slower)

    def _separate(self, old_origin: np.ndarray, old_tip: np.ndarray, h: float, gap: float = 0.0) -> None:
        """Contact: links push objects, objects push each other, walls stop them. The links were at
        `old_origin` and `old_tip` [n, L, 2] h seconds ago. Things nearer than `gap` are in contact."""
        s, size, bounce = self._state, self.spec.task.size, self.spec.physics.bounce
        for i in self.pushers:
            link = self.body.links[i]
            a, b = self.pose.origin[:, i, None], self.pose.tip[:, i, None]
            along = b - a
            t = np.clip(_dot(s.objects - a, along) / max(link.length**2, 1e-9), 0.0, 1.0)
            near = a + t * along
            away = s.objects - near
            distance = np.sqrt(_dot(away, away))
            overlap = np.maximum(size + link.radius + link.half_width + gap - distance, 0.0)
            if not overlap.any():
                continue
            before = old_origin[:, i, None] * (1 - t) + old_tip[:, i, None] * t
            normal = away / np.maximum(distance, 1e-6)
            s.objects += normal * overlap
            closing = _dot(s.object_v - (near - before) / h, normal)
            s.object_v -= np.where((overlap > 0) & (closing < 0), (1 + bounce) * closing, 0.0) * normal
        for k in range(s.objects.shape[1]):
            for j in range(k):
                away = s.objects[:, k] - s.objects[:, j]
                distance = np.sqrt(_dot(away, away))
                overlap = np.maximum(2 * size + gap - distance, 0.0)
                if not overlap.any():
                    continue
                normal = away / np.maximum(distance, 1e-6)
                closing = _dot(s.object_v[:, k] - s.object_v[:, j], normal)
                push = np.where((overlap > 0) & (closing < 0), -(1 + bounce) * closing / 2, 0.0)  # equal mass
                for which, sign in ((k, 0.5), (j, -0.5)):
                    s.objects[:, which] += normal * overlap * sign
                    s.object_v[:, which] += normal * push * 2 * sign
        wall = EDGE - size
        outward = (np.abs(s.objects) > wall) & (s.objects * s.object_v > 0)
        s.object_v[outward] *= -bounce
        np.clip(s.objects, -wall, wall, out=s.objects)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[..., 1], the scalar product of vectors [..., 2]: numpy is slow at sums over so short an axis."""
    product = a * b
    return product[..., :1] + product[..., 1:]
