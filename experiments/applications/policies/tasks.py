"""Tasks of policies, and when they succeed: by the state for robots with a true simulator, by recordings for others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from data_pipelines.simulators.record import instruction
from data_pipelines.simulators.simulator import PHYSICS
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.tasks import Push, Reach, Scene
from data_pipelines.suite.world import State, World
from hma_jax.config import require

Arrays = TypeVar("Arrays")

OWN, REACH, HOVER = "own", "reach", "hover"
TASKS = (OWN, REACH, HOVER)

EXPERTS = {name: spec for name, spec in PHYSICS.items() if spec.success and spec.expert}
"""Robots of physics simulators that report when their single task is done, and for which there is an expert."""

ROBOTS = (*SPECS, *EXPERTS)
"""All that have a task."""

PHYSICS_FRAMES = 24
"""One and a half times as many as an undisturbed expert takes to open the drawer, at 4 frames a second. Other robots
and rates were not measured: give `frames`."""

RADIUS = 0.22
"""Distance within which a tool has reached the mark, in halves of the floor's side: a little less than the mark's own
radius."""


@dataclass(frozen=True)
class ReachMark(Reach):
    """The tool nearer to the mark than the mark is large, whose size and the episode's start stay what they were."""

    within: float = RADIUS

    def done(self, scene: Scene) -> np.ndarray:
        return self.distance(scene) < self.within

    def distance(self, scene: Scene) -> np.ndarray:
        """float [n]: how far the farthest tool is from its mark."""
        return np.linalg.norm(scene.tools - scene.goals, axis=-1).max(1)


@dataclass(frozen=True)
class HoverPuck(ReachMark):
    """The first tool above the puck that is nearest to it, its gripper open; for robots that pass above things."""

    within: float = 0.3  # a little more than a puck's radius
    step: float = 0.4  # largest distance that the expert moves the tool at once, world units

    def plan(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        target, move = scene.tools.copy(), self._move(scene)
        target[:, 0] += move * np.minimum(self.step / np.maximum(np.linalg.norm(move, axis=-1), 1e-9), 1.0)[:, None]
        return target, np.ones(target.shape[:2])

    def distance(self, scene: Scene) -> np.ndarray:
        """float [n]: how far the tool is from the nearest puck."""
        return np.linalg.norm(self._move(scene), axis=-1)

    def _move(self, scene: Scene) -> np.ndarray:
        """[n, 2], from the tool to that puck."""
        moves = scene.objects - scene.tools[:, :1]
        return moves[np.arange(len(moves)), np.linalg.norm(moves, axis=-1).argmin(1)]


@dataclass(frozen=True)
class Task:
    """A task of one robot. An episode succeeds when the goal is reached at `hold` frames in a row, within `frames`."""

    robot: str
    name: str
    frames: int = 16
    hold: int = 2

    def __post_init__(self):
        require(
            self.robot in ROBOTS,
            f"robot {self.robot!r} has no task: a task needs a true simulator, which says when it is done, and a "
            f"scripted expert. These exist for the robots of the suite (docs/suite.md), {', '.join(EXPERTS)}; for other "
            "robots use `hma judge --recordings`",
        )
        known = TASKS if self.in_suite else (OWN,)
        require(self.name in known, f"{self.robot} has no task {self.name!r}; it has {', '.join(known)}")
        require(
            1 <= self.hold <= self.frames,
            f"the goal cannot be held for {self.hold} frames in an episode of {self.frames} frames",
        )

    @property
    def in_suite(self) -> bool:
        """Whether the task's robot is from the suite, not from a physics simulator."""
        return self.robot in SPECS

    @property
    def spec(self) -> EmbodimentSpec:
        """The suite's robot with this task. It differs from the robot's own spec only in what counts as done: frames
        look the same."""
        require(self.in_suite, f"{self.robot} is a robot of a physics simulator, whose task only `hma judge` supports")
        spec = SPECS[self.robot]
        if self.name == OWN:
            return spec
        own, kind = spec.task, ReachMark if self.name == REACH else HoverPuck
        return replace(spec, task=kind(own.radius, own.objects, own.size, own.carries, own.marks_object))

    @property
    def physics(self) -> SimSpec:
        """The robot of a physics simulator."""
        return EXPERTS[self.robot]

    @property
    def goal(self) -> str:
        """The goal in words."""
        if not self.in_suite:
            return instruction(self.physics, self.physics.envs[0])
        if self.name != OWN:
            return "the tool on the mark" if self.name == REACH else "the tool above a puck"
        return "the puck on the mark" if isinstance(SPECS[self.robot].task, Push) else "the puck carried to the mark"


@dataclass(frozen=True)
class RecordedTask:
    """What a robot without a true simulator has to do, as shown by its recordings; otherwise like `Task`."""

    robot: str
    frames: int = 0  # 0: as long as most of the recorded successes
    hold: int = 2
    reward: float | None = None  # least reward of a step that has reached the goal; None: only their ends say it
    goal: str = ""  # in words, if the recordings have some
    name: str = "recorded"

    def __post_init__(self):
        require(self.frames >= 0, f"--frames must not be negative, got {self.frames}")
        longest = self.frames or self.hold
        require(
            1 <= self.hold <= longest,
            f"--hold {self.hold} is more than the {longest} frames of an episode (--frames)",
        )


AnyTask = Task | RecordedTask


def find_task(robot: str, name: str = OWN, frames: int | None = None, hold: int | None = None) -> Task:
    """A task with its usual length, unless another is given. Raises ConfigError for a task that does not exist."""
    task = Task(robot, name)
    usual_frames = Task.frames if task.in_suite else PHYSICS_FRAMES
    # A tool that wanders passes over the mark; one that was steered there stays.
    usual_hold = Task.hold if name == OWN else 4
    return Task(robot, name, usual_frames if frames is None else frames, usual_hold if hold is None else hold)


def join(parts: Sequence[Arrays]) -> Arrays:
    """Several dataclasses of arrays, each with a row per episode, joined into one with all episodes."""
    names = [f.name for f in fields(parts[0])]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def world_of(spec: EmbodimentSpec, states: Sequence[State]) -> World:
    """A world that continues from these states."""
    state = join(states)
    world = World(spec, state.seeds)
    world.state = state
    return world


def held(reached_NL: np.ndarray, hold: int) -> np.ndarray:
    """bool [N, L]: the goal was reached at this frame and the hold - 1 before it."""
    padded = np.pad(reached_NL, ((0, 0), (hold, 0)))  # one longer than needed: there may be no frame
    return sliding_window_view(padded, hold, axis=1).all(-1)[:, 1:]
