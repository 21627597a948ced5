"""The scripted behaviour policy: a mixture of the task, exploration and noise.

Decides which configuration to move to next and lets the controls turn that into action
values. It sees the whole state; the physics sees only its actions.
"""

from __future__ import annotations

import numpy as np

from data_pipelines.suite.world import World


class Behaviour:
    """Works on the task part of the time and explores randomly drawn configurations otherwise.

    The explored goal changes at random moments, so that the future cannot be predicted from past frames alone:
    a video model must use the actions.
    """

    def __init__(self, world: World, rng: np.random.Generator, *, expert: bool = False):
        """An `expert` does not explore: it works on the task all the time, and stays where it is once the task is
        done."""
        n = len(world)
        self.world, self.rng, self.expert = world, rng, expert
        self.task_probability = world.spec.purpose * rng.uniform(0.0, 2.0, n)  # some episodes only explore
        if expert:
            self.task_probability = np.ones(n)
        self.on_task = rng.random(n) < self.task_probability
        self.explored_goal = world.body.random(rng, n)
        self.bias = np.zeros_like(world.q)
        self.done = np.zeros(n, bool)

    def act(self) -> np.ndarray:
        """[n, A] actions for the present state."""
        world, spec, body, rng = self.world, self.world.spec, self.world.body, self.rng
        n = len(world)
        self.done |= world.success() & (not self.expert)
        change = rng.random(n) < spec.restless * world.dt
        self.on_task = np.where(change, rng.random(n) < self.task_probability, self.on_task) & ~self.done
        arrived = np.abs(self.explored_goal - world.q).max(1) < 0.15
        explored_goal = body.random(rng, n)
        for grip in body.grips:
            if grip >= 0:
                explored_goal[:, grip] = rng.random(n) < 0.5
        change = (rng.random(n) < spec.restless * world.dt) | arrived
        self.explored_goal = np.where(change[:, None], explored_goal, self.explored_goal)

        goal = np.where(self.on_task[:, None], self._task_goal(), self.explored_goal)
        decay = np.exp(-world.dt / 0.5)
        noise = np.sqrt(1 - decay**2) * rng.standard_normal(goal.shape)
        self.bias = decay * self.bias + noise
        goal = np.clip(goal + self.bias * spec.noise * body.speed * 0.5, body.low, body.high)
        return np.concatenate([c.encode(body, world.q, goal, world.dt) for c in spec.controls], 1)

    def _task_goal(self) -> np.ndarray:
        """[n, C]: the configuration to reach for the task; joints that the task does not need explore."""
        world, body = self.world, self.world.body
        target, opening = world.spec.task.plan(world)
        move = target - world.tools
        far = np.linalg.norm(move, axis=-1, keepdims=True)
        move = move * np.minimum(1.0, 0.4 / np.maximum(far, 1e-9))
        goal = world.q + body.solve(world.pose, move)
        busy = body.tool_joints[world.hand]
        goal = np.where(busy, goal, self.explored_goal)
        for m, grip in enumerate(body.grips):
            if grip >= 0:
                goal[:, grip] = np.where(np.isnan(opening[:, m]), self.explored_goal[:, grip], opening[:, m])
        return goal
