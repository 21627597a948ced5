"""The scripted behaviour: what robots do, mixed from task, exploration and imprecision.

Decides where a configuration should go next and lets the controls put that into action
values. It sees the whole state; the physics sees only its actions.
"""

from __future__ import annotations

import numpy as np

from data_pipelines.suite.world import World


class Behaviour:
    """Scripted and restless: part of the time on the task, part on wishes of its own.

    Wishes change at random moments, so that the future cannot be told from the past alone:
    a video model must look at the actions.
    """

    def __init__(self, world: World, rng: np.random.Generator, *, expert: bool = False):
        """An `expert` has no wishes: it is on the task at every moment, and stays where it is done."""
        n = len(world)
        self.world, self.rng, self.expert = world, rng, expert
        self.purpose = world.spec.purpose * rng.uniform(0.0, 2.0, n)  # some only play
        if expert:
            self.purpose = np.ones(n)
        self.on_task = rng.random(n) < self.purpose
        self.wish = world.body.random(rng, n)
        self.bias = np.zeros_like(world.q)
        self.done = np.zeros(n, bool)

    def act(self) -> np.ndarray:
        """[n, A] actions for the present state."""
        world, spec, body, rng = self.world, self.world.spec, self.world.body, self.rng
        n = len(world)
        self.done |= world.success() & (not self.expert)
        change = rng.random(n) < spec.restless * world.dt
        self.on_task = np.where(change, rng.random(n) < self.purpose, self.on_task) & ~self.done
        arrived = np.abs(self.wish - world.q).max(1) < 0.15
        wish = body.random(rng, n)
        for grip in body.grips:
            if grip >= 0:
                wish[:, grip] = rng.random(n) < 0.5
        change = (rng.random(n) < spec.restless * world.dt) | arrived
        self.wish = np.where(change[:, None], wish, self.wish)

        goal = np.where(self.on_task[:, None], self._task_goal(), self.wish)
        fade = np.exp(-world.dt / 0.5)
        kick = np.sqrt(1 - fade**2) * rng.standard_normal(goal.shape)
        self.bias = fade * self.bias + kick
        goal = np.clip(goal + self.bias * spec.noise * body.speed * 0.5, body.low, body.high)
        return np.concatenate([c.encode(body, world.q, goal, world.dt) for c in spec.controls], 1)

    def _task_goal(self) -> np.ndarray:
        """[n, C]: the configuration that serves the task; joints it does not need explore."""
        world, body = self.world, self.world.body
        target, opening = world.spec.task.plan(world)
        move = target - world.tools
        far = np.linalg.norm(move, axis=-1, keepdims=True)
        move = move * np.minimum(1.0, 0.4 / np.maximum(far, 1e-9))
        goal = world.q + body.solve(world.pose, move)
        busy = body.tool_joints[world.hand]
        goal = np.where(busy, goal, self.wish)
        for m, grip in enumerate(body.grips):
            if grip >= 0:
                goal[:, grip] = np.where(np.isnan(opening[:, m]), self.wish[:, grip], opening[:, m])
        return goal
