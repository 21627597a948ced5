"""The simulator: many episodes of one embodiment at once, quasi-static, in numpy.

Owns the state, contact, grasping and distractors; it does what actions say and decides
nothing. All episodes advance together.
"""

from __future__ import annotations

import numpy as np

from data_pipelines.suite.bodies import Pose
from data_pipelines.suite.spec import EmbodimentSpec

SUBSTEP_SECONDS = 1 / 15
"""Longest physics step: bodies move less than an object's radius in it."""

WALL = 0.8
"""Objects stay within [-WALL, WALL]."""


class World:
    """The state of n episodes and its physics."""

    def __init__(self, spec: EmbodimentSpec, n: int, rng: np.random.Generator):
        body, task = spec.body, spec.task
        self.spec, self.body, self.dt = spec, body, 1.0 / spec.hz
        self.substeps = int(np.ceil(self.dt / SUBSTEP_SECONDS - 1e-9))
        self.q = body.random(rng, n, 0.7)
        self.goals = self._reachable(rng, n)
        self.objects = np.stack([self._reachable(rng, n)[:, 0] for _ in range(task.objects)], 1) if (
            task.objects
        ) else np.zeros((n, 0, 2))
        if task.objects:  # an object that starts on its mark would be an empty task
            away = self.objects[:, 0] - self.goals[:, 0]
            close = np.linalg.norm(away, axis=1) < 2.5 * task.radius
            self.objects[close, 0] = -self.objects[close, 0]
        look = spec.look
        self.distractors = rng.uniform(-0.9, 0.9, (n, look.distractors, 2))
        heading = rng.uniform(0, 2 * np.pi, (n, look.distractors))
        self.drift = look.distractor_speed * np.stack([np.cos(heading), np.sin(heading)], -1)
        self.held = np.full((n, len(body.tools)), -1)
        self.hold = np.zeros((n, len(body.tools), 2))
        self.done = np.zeros(n, bool)
        self.pushers = [i for i, link in enumerate(body.links) if link.touches] if task.pushes else []
        self.tool_radius = max((body.links[i].radius for i in self.pushers), default=0.1)
        self.grasp = task.size + 0.1
        self.pose: Pose = body.pose(self.q)
        for _ in range(20):  # random places overlap; nothing may move by itself later
            self._separate()
        distance = (
            np.linalg.norm(self.tools - self.objects[:, :1], axis=-1)
            if task.objects
            else np.zeros((n, len(body.tools)))
        )
        self.hand = distance.argmin(1)  # the tool that does the task

    @property
    def tools(self) -> np.ndarray:
        """[n, M, 2]"""
        return self.body.tool_points(self.pose)

    def _reachable(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """[n, M, 2] points that the tools of a random configuration have."""
        points = self.body.tool_points(self.body.pose(self.body.random(rng, n, 0.85)))
        return np.clip(points, -0.7, 0.7)

    def step(self, action: np.ndarray) -> None:
        """One native step under `action` [n, A]."""
        h = self.dt / self.substeps
        for _ in range(self.substeps):
            start = 0
            for control in self.spec.controls:
                control.advance(self.body, self.q, action[:, start : start + control.dim], h, self.dt)
                start += control.dim
            self.body.confine(self.q)
            self.pose = self.body.pose(self.q)
            if self.spec.task.carries:
                self._grip()
            self._separate()
            self._wander(h)

    def _grip(self) -> None:
        """Closed grippers hold what is between their fingers; open ones let go."""
        rows = np.arange(len(self.q))
        tools = self.tools
        for m, joint in enumerate(self.body.grips):
            if joint < 0:
                continue
            away = self.objects - tools[:, m, None]
            distance = np.linalg.norm(away, axis=-1)
            nearest = distance.argmin(1)
            closed = self.q[:, joint] < 0.35
            free = self.held[:, m] < 0
            grasp = closed & free & (distance[rows, nearest] < self.grasp)
            grasp &= ~(self.held == nearest[:, None]).any(1)  # two hands do not share
            self.held[grasp, m] = nearest[grasp]
            self.hold[grasp, m] = away[rows, nearest][grasp]
            self.held[self.q[:, joint] > 0.6, m] = -1
            has = self.held[:, m] >= 0
            self.hold[:, m] *= 0.8  # a held object settles between the fingers
            self.objects[rows[has], self.held[has, m]] = (tools[:, m] + self.hold[:, m])[has]

    def _separate(self) -> None:
        """Quasi-static contact: links push objects, objects push each other, walls stop them."""
        count, size = self.objects.shape[1], self.spec.task.size
        for i in self.pushers:
            link = self.body.links[i]
            a, b = self.pose.origin[:, i], self.pose.tip[:, i]
            gap = size + link.radius + link.half_width
            for k in range(count):
                point = self.objects[:, k]
                along = b - a
                t = ((point - a) * along).sum(1) / max(link.length**2, 1e-9)
                near = a + np.clip(t, 0.0, 1.0)[:, None] * along
                self._push_out(point, near, gap)
        for k in range(count):
            for j in range(k):
                away = self.objects[:, k] - self.objects[:, j]
                distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
                shift = away / distance * np.maximum(2 * size - distance, 0.0) / 2
                self.objects[:, k] += shift
                self.objects[:, j] -= shift
        np.clip(self.objects, -WALL, WALL, out=self.objects)

    @staticmethod
    def _push_out(point: np.ndarray, near: np.ndarray, gap: float) -> None:
        away = point - near
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        overlap = np.maximum(gap - distance, 0.0)
        point += away / np.maximum(distance, 1e-6) * overlap

    def _wander(self, h: float) -> None:
        self.distractors += self.drift * h
        outside = (np.abs(self.distractors) > 0.95) & (self.distractors * self.drift > 0)
        self.drift[outside] *= -1.0
