"""What policies of the suite's robots are to do, and when it is done: by the simulator's state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.tasks import Push, Reach, Scene
from data_pipelines.suite.world import State, World
from hma_jax.config import require

OWN, REACH = "own", "reach"
TASKS = (OWN, REACH)

RADIUS = 0.22
"""Within which a tool has reached the mark, in halves of the floor's side: a little less than the mark's own."""


@dataclass(frozen=True)
class ReachMark(Reach):
    """The tool nearer to the mark than the mark is large, whose size and the episode's start stay what they were."""

    within: float = RADIUS

    def done(self, scene: Scene) -> np.ndarray:
        return (np.linalg.norm(scene.tools - scene.goals, axis=-1) < self.within).all(1)


@dataclass(frozen=True)
class Task:
    """A task of one robot. An episode succeeds when the goal is reached at `hold` frames in a row, within `frames`."""

    robot: str
    name: str
    frames: int = 16
    hold: int = 2

    def __post_init__(self):
        require(self.robot in SPECS, f"the suite has no robot {self.robot!r}; it has {', '.join(SPECS)}")
        require(self.name in TASKS, f"no task {self.name!r}; there are {', '.join(TASKS)}")
        require(1 <= self.hold <= self.frames, f"a goal held for {self.hold} frames does not fit {self.frames} frames")

    @property
    def spec(self) -> EmbodimentSpec:
        """The robot with this task. Only what counts as done differs from its own: frames look the same."""
        spec = SPECS[self.robot]
        if self.name == OWN:
            return spec
        own = spec.task
        return replace(spec, task=ReachMark(own.radius, own.objects, own.size, own.carries, own.marks_object))

    @property
    def goal(self) -> str:
        """In words."""
        if self.name == REACH:
            return "the tool on the mark"
        return "the puck on the mark" if isinstance(SPECS[self.robot].task, Push) else "the puck carried to the mark"


def find_task(robot: str, name: str = OWN, frames: int | None = None, hold: int | None = None) -> Task:
    """A task with its usual length, unless another is given. Raises ConfigError for one that there is not."""
    task = Task(robot, name)
    # A tool that wanders passes over the mark; one that was steered there stays.
    task = replace(task, frames=16, hold=4) if name == REACH else task
    return replace(task, frames=frames or task.frames, hold=hold or task.hold)


def stack(states: Sequence[State]) -> State:
    """States of one robot as one of all their episodes."""
    return State(**{f.name: np.concatenate([getattr(s, f.name) for s in states]) for f in fields(State)})


def reached(spec: EmbodimentSpec, states: Sequence[State]) -> np.ndarray:
    """bool [n]: the goal of the spec's task is reached in each state."""
    return world_of(spec, states).success()


def world_of(spec: EmbodimentSpec, states: Sequence[State]) -> World:
    """A world that goes on from these states."""
    state = stack(states)
    world = World(spec, state.seeds)
    world.state = state
    return world


def held(reached_NL: np.ndarray, hold: int) -> np.ndarray:
    """bool [N, L]: the goal was reached at this frame and the hold - 1 before it."""
    runs = np.zeros(reached_NL.shape, int)
    count = np.zeros(len(reached_NL), int)
    for t in range(reached_NL.shape[1]):
        count = np.where(reached_NL[:, t], count + 1, 0)
        runs[:, t] = count
    return runs >= hold
