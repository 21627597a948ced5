"""Long sequences of actions for a robot, and the true rollout under them, from one start, in the true simulator.

Actions come from the suite's behaviour, which sees the true state, or are of two kinds unlike anything that was
recorded. The model is then given the same actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.behaviour import Behaviour
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import World
from experiments.applications.detector import suite_robots
from experiments.applications.scenes import Points, points_of
from hma_jax.config import require
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

Kind = Literal["behaviour", "extremes", "alternation"]
"""`behaviour`: as recorded, restarted every `RESTART_SECONDS`; `extremes`: one action value after the other held at an
end of its range for `HOLD_SECONDS`, the others at rest; `alternation`: all values jump from end to end every frame."""

RESTART_SECONDS, HOLD_SECONDS = 12.0, 2.0


@dataclass(frozen=True)
class Drive:
    """n frames after a start. The state at t = 0 is the start's last frame."""

    robot: Robot
    start: Start
    actions: np.ndarray  # float32 [n, A], raw and within the range
    q: np.ndarray  # [n + 1, C]
    objects: np.ndarray  # [n + 1, K, 2]
    goals: np.ndarray  # [1, M, 2]

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def spec(self) -> EmbodimentSpec:
        return SPECS[self.robot.name]

    def frames(self, first: int, stop: int) -> np.ndarray:
        """True frames uint8 [stop - first, H, W, 3]."""
        q, objects = self.q[first:stop], self.objects[first:stop]
        looks = draw_appearance(self.spec, [self.start.seed])
        return render_frames(self.spec, looks, self.goals, q, objects, np.zeros(len(q), int))

    def points(self) -> Points:
        """The points in all n + 1 states."""
        return points_of(self.spec, np.full(len(self.q), self.start.seed), self.q, self.objects)


def native_robots(robots: Mapping[str, Robot]) -> dict[str, Robot]:
    """The robots of the suite that the model runs at their native rate (stride 1). Raises ConfigError if there are
    none."""
    native = {name: robot for name, robot in suite_robots(robots).items() if robot.stride == 1}
    require(
        bool(native),
        "the model needs a robot of the suite at its native rate, since a drive has an action for every frame",
    )
    return native


def make_drive(robot: Robot, start: Start, frames: int, kind: Kind, seed: int) -> Drive:
    """The true rollout of `frames` actions of a kind. Deterministic; `start` must have the seed of its episode. Every
    robot has its own random numbers, since intervals assume that robots are independent."""
    spec = SPECS[robot.name]
    world = World(spec, [start.seed])
    for action in start.actions:
        world.step(action[None].astype(np.float64))
    q, objects, actions, behaviour = [world.q.copy()], [world.objects.copy()], [], None
    restart = max(round(RESTART_SECONDS * spec.hz), 1)
    for t in range(frames):
        if kind == "behaviour":
            if t % restart == 0:
                behaviour = Behaviour(world, np.random.default_rng([seed, t, *map(ord, spec.name)]))
            command = behaviour.act()[0]
        else:
            command = _extreme_action(robot, kind, t)
        action = robot.clip_to_range(np.asarray(command, np.float32), "clip")[0]
        world.step(action[None].astype(np.float64))
        actions.append(action)
        q.append(world.q.copy())
        objects.append(world.objects.copy())
    return Drive(robot, start, np.stack(actions), np.concatenate(q), np.concatenate(objects), world.goals)


def _extreme_action(robot: Robot, kind: Kind, t: int) -> np.ndarray:
    if kind == "alternation":
        return np.array(robot.high if t % 2 else robot.low)
    turn = t // max(round(HOLD_SECONDS * robot.hz), 1)
    dimension, end = turn // 2 % robot.action_dim, (robot.high, robot.low)[turn % 2]
    action = np.array(robot.rest)
    action[dimension] = end[dimension]
    return action
